#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// As decode_hidden, for subgroups of 8 (CPU drivers): a subgroup takes 64 anchors, 8 in a lane, and half of the units, of
// whose weights each lane loads an eighth.
layout(local_size_x = 8) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };    // of decode_pack
layout(binding = 2, scalar) readonly buffer Inputs { vec4 inputs[]; };    // [V*10] of decode_input
layout(binding = 3, scalar) writeonly buffer Hidden { vec4 hidden[]; };   // [V*24] opacity 32, color 32, cov 32
layout(binding = 4, scalar) writeonly buffer Positive { uint positive[]; }; // [V*6] 16 bits each: which of the units are positive
void main() {
  const uint PARTS = 2u, ALL = HEADS * HIDDEN / PARTS, LOADS = ALL / 8u;
  uint id = group_index(), lane = gl_SubgroupInvocationID, n = groups[3];
  uint unit = ALL * (id % PARTS), v = LANES_ANCHORS * (id / PARTS) + lane;
  if (v - lane >= n) return;
  float sum[8u * ALL];
  [[unroll]] for (uint i = 0u; i < 8u * ALL; ++i) sum[i] = 0.0;
  uint from[8];
  [[unroll]] for (uint a = 0u; a < 8u; ++a) from[a] = min(v + 8u * a, n - 1u) * INPUT_VEC4;
  for (uint i = 0u; i < INPUT_VEC4; ++i) {
    vec4 x[8], w[LOADS];
    [[unroll]] for (uint a = 0u; a < 8u; ++a) x[a] = inputs[from[a] + i];
    [[unroll]] for (uint b = 0u; b < LOADS; ++b) w[b] = packed[(unit + 8u * b + lane) * INPUT_VEC4 + i];
    [[unroll]] for (uint u = 0u; u < ALL; ++u) {
      vec4 row = subgroupShuffle(w[u / 8u], u % 8u);
      [[unroll]] for (uint a = 0u; a < 8u; ++a) sum[ALL * a + u] = dot_add(sum[ALL * a + u], x[a], row);
    }
  }
  [[unroll]] for (uint a = 0u; a < 8u; ++a) {
    if (v + 8u * a < n) {
      uint to = (v + 8u * a) * HIDDEN_VEC4 + unit / 4u;
      [[unroll]] for (uint run = 0u; run < ALL / UNITS; ++run) {
        uint bits = 0u;
        [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) {
          uint u = ALL * a + UNITS * run + 4u * q;
          vec4 h = max(vec4(sum[u], sum[u + 1u], sum[u + 2u], sum[u + 3u]), 0.0);
          hidden[to + UNITS_VEC4 * run + q] = h;
          bits |= positive_bits(h, q);
        }
        positive[(v + 8u * a) * POSITIVE + unit / UNITS + run] = bits;
      }
    }
  }
}
