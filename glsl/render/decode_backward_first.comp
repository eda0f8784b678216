#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// First layer's weight gradients, summed over each chunk of visible anchors. A thread computes 8 units by 20 inputs.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Inputs { vec4 inputs[]; };          // [V*10] of decode_input
layout(binding = 2, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; }; // [V*24] of decode_backward_hidden
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [chunk*96*10] like the packed first layer
void main() {
  const uint WIDE = INPUT_VEC4 / 2u, PARTS = 24u;
  uint t = thread_index(), n = groups[3], chunk = chunk_anchors(n);
  uint tile = t % PARTS, part = t / PARTS, row = 2u * (tile / 2u), column = WIDE * (tile % 2u);
  if (part * chunk >= n) return;
  vec4 sum[8u * WIDE];
  [[unroll]] for (uint i = 0u; i < 8u * WIDE; ++i) sum[i] = vec4(0.0);
  uint end = min(n, (part + 1u) * chunk);
  for (uint v = part * chunk; v < end; ++v) {
    vec4 x[WIDE];
    [[unroll]] for (uint i = 0u; i < WIDE; ++i) x[i] = inputs[v * INPUT_VEC4 + column + i];
    [[unroll]] for (uint r = 0u; r < 2u; ++r) {
      vec4 g = grad_hidden[v * HIDDEN_VEC4 + row + r];
      [[unroll]] for (uint c = 0u; c < 4u; ++c) {
        uint u = (4u * r + c) * WIDE;
        [[unroll]] for (uint i = 0u; i < WIDE; ++i) sum[u + i] = add_scaled(sum[u + i], g[c], x[i]);
      }
    }
  }
  [[unroll]] for (uint u = 0u; u < 8u; ++u) {
    uint to = part * FIRST_VEC4 + (4u * row + u) * INPUT_VEC4 + column;
    [[unroll]] for (uint i = 0u; i < WIDE; ++i) partial[to + i] = sum[u * WIDE + i];
  }
}
