#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the first layer to the features. A thread computes UNITS features of TILE anchors.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint TILE = 8u; // anchors of a thread
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };            // [V] anchors
layout(binding = 2, scalar) readonly buffer Packed { vec4 packed[]; };              // of decode_pack
layout(binding = 3, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; };     // [V*24] of decode_backward_hidden
layout(binding = 4, scalar) writeonly buffer GradFeature { float grad_feature[]; }; // [N*32] visible anchors only
void main() {
  const uint PARTS = FEATURE / UNITS;
  uint t = thread_index(), n = groups[3];
  uint column = UNITS_VEC4 * (t % PARTS), v = TILE * (t / PARTS);
  if (v >= n) return;
  vec4 sum[UNITS_VEC4 * TILE];
  [[unroll]] for (uint i = 0u; i < UNITS_VEC4 * TILE; ++i) sum[i] = vec4(0.0);
  uint from[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * HIDDEN_VEC4;
  for (uint r = 0u; r < HIDDEN_VEC4; ++r) {
    vec4 g[TILE];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) g[a] = grad_hidden[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) {
        vec4 w = packed[(4u * r + c) * INPUT_VEC4 + column + q];
        [[unroll]] for (uint a = 0u; a < TILE; ++a) sum[UNITS_VEC4 * a + q] = add_scaled(sum[UNITS_VEC4 * a + q], g[a][c], w);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (v + a < n) {
      uint to = visible[v + a] * FEATURE + 4u * column;
      [[unroll]] for (uint i = 0u; i < UNITS; ++i) grad_feature[to + i] = sum[UNITS_VEC4 * a + i / 4u][i % 4u];
    }
  }
}
