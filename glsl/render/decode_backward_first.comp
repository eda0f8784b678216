#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// First layer's weight gradients: a workgroup sums over one chunk of visible anchors, a thread computes 8 units by 8 inputs.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Inputs { vec4 inputs[]; };          // [V*10] of decode_input
layout(binding = 2, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; }; // [V*24] of decode_backward_hidden
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [chunk*96*10] like the packed first layer
void main() {
  uint n = groups[3], chunk = chunk_anchors(n), part = group_index();
  uint tile = gl_LocalInvocationID.x, row = 2u * (tile / 5u), column = 2u * (tile % 5u);
  if (tile >= 60u || part * chunk >= n) return;
  vec4 sum[16];
  [[unroll]] for (uint i = 0u; i < 16u; ++i) sum[i] = vec4(0.0);
  uint end = min(n, (part + 1u) * chunk);
  for (uint v = part * chunk; v < end; ++v) {
    vec4 x0 = inputs[v * INPUT_VEC4 + column], x1 = inputs[v * INPUT_VEC4 + column + 1u];
    vec4 g0 = grad_hidden[v * HIDDEN_VEC4 + row], g1 = grad_hidden[v * HIDDEN_VEC4 + row + 1u];
    [[unroll]] for (uint i = 0u; i < 4u; ++i) {
      sum[2u * i] = add_scaled(sum[2u * i], g0[i], x0);
      sum[2u * i + 1u] = add_scaled(sum[2u * i + 1u], g0[i], x1);
      sum[2u * i + 8u] = add_scaled(sum[2u * i + 8u], g1[i], x0);
      sum[2u * i + 9u] = add_scaled(sum[2u * i + 9u], g1[i], x1);
    }
  }
  [[unroll]] for (uint i = 0u; i < 8u; ++i) {
    uint to = part * FIRST_VEC4 + (4u * row + i) * INPUT_VEC4 + column;
    partial[to] = sum[2u * i];
    partial[to + 1u] = sum[2u * i + 1u];
  }
}
