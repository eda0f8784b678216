#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Hidden units of the three heads, ReLU(W x + b). A thread computes UNITS units of TILE anchors: each load serves several products.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint TILE = 8u; // anchors of a thread
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };    // of decode_pack
layout(binding = 2, scalar) readonly buffer Inputs { vec4 inputs[]; };    // [V*10] of decode_input
layout(binding = 3, scalar) writeonly buffer Hidden { vec4 hidden[]; };   // [V*24] opacity 32, color 32, cov 32
layout(binding = 4, scalar) writeonly buffer Positive { uint positive[]; }; // [V*6] 16 bits each: which of the units are positive
void main() {
  const uint PARTS = HEADS * HIDDEN / UNITS;
  uint t = thread_index(), n = groups[3];
  uint unit = UNITS * (t % PARTS), v = TILE * (t / PARTS);
  if (v >= n) return;
  float sum[UNITS * TILE];
  [[unroll]] for (uint i = 0u; i < UNITS * TILE; ++i) sum[i] = 0.0;
  uint from[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * INPUT_VEC4;
  for (uint i = 0u; i < INPUT_VEC4; ++i) {
    vec4 x[TILE];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) x[a] = inputs[from[a] + i];
    [[unroll]] for (uint u = 0u; u < UNITS; ++u) {
      vec4 w = packed[(unit + u) * INPUT_VEC4 + i];
      [[unroll]] for (uint a = 0u; a < TILE; ++a) sum[UNITS * a + u] = dot_add(sum[UNITS * a + u], x[a], w);
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (v + a < n) {
      uint to = (v + a) * HIDDEN_VEC4 + unit / 4u;
      uint bits = 0u;
      [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) {
        uint u = UNITS * a + 4u * q;
        vec4 h = max(vec4(sum[u], sum[u + 1u], sum[u + 2u], sum[u + 3u]), 0.0);
        hidden[to + q] = h;
        bits |= positive_bits(h, q);
      }
      positive[(v + a) * POSITIVE + unit / UNITS] = bits;
    }
  }
}
