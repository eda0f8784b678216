#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Hidden units of the three heads, ReLU(W x + b). A thread computes 8 units of TILE anchors: each load serves several products.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };    // of decode_pack
layout(binding = 2, scalar) readonly buffer Inputs { vec4 inputs[]; };    // [V*10] of decode_input
layout(binding = 3, scalar) writeonly buffer Hidden { vec4 hidden[]; };   // [V*24] opacity 32, color 32, cov 32
void main() {
  uint t = thread_index(), n = groups[3];
  uint unit = 8u * (t % 12u), v = TILE * (t / 12u);
  if (v >= n) return;
  float sum[8u * TILE];
  [[unroll]] for (uint i = 0u; i < 8u * TILE; ++i) sum[i] = 0.0;
  uint from[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * INPUT_VEC4;
  for (uint i = 0u; i < INPUT_VEC4; ++i) {
    vec4 x[TILE];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) x[a] = inputs[from[a] + i];
    [[unroll]] for (uint u = 0u; u < 8u; ++u) {
      vec4 w = packed[(unit + u) * INPUT_VEC4 + i];
      [[unroll]] for (uint a = 0u; a < TILE; ++a) sum[8u * a + u] = dot_add(sum[8u * a + u], x[a], w);
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (v + a >= n) return;
    uint to = (v + a) * HIDDEN_VEC4 + unit / 4u;
    hidden[to] = max(vec4(sum[8u * a], sum[8u * a + 1u], sum[8u * a + 2u], sum[8u * a + 3u]), 0.0);
    hidden[to + 1u] = max(vec4(sum[8u * a + 4u], sum[8u * a + 5u], sum[8u * a + 6u], sum[8u * a + 7u]), 0.0);
  }
}
