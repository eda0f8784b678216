#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// As decode_backward_hidden, for subgroups of 8 (CPU drivers): a subgroup takes 64 anchors, 8 in a lane, and the units of
// one head, of whose weights each lane loads an eighth.
layout(local_size_x = 8) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };            // of decode_pack
layout(binding = 2, scalar) readonly buffer Positive { uint positive[]; };        // [V*6] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { vec4 grad_output[]; };   // [V*D/4] of decode_backward
layout(binding = 4, scalar) writeonly buffer GradHidden { vec4 grad_hidden[]; };  // [V*24] before the ReLU
void main() {
  uint id = group_index(), lane = gl_SubgroupInvocationID, n = groups[3];
  uint head = id % HEADS, v = LANES_ANCHORS * (id / HEADS) + lane, stride = head_row(3u, OFFSETS) / 4u;
  if (v - lane >= n) return;
  vec4 sum[8u * ROW_VEC4];
  [[unroll]] for (uint i = 0u; i < 8u * ROW_VEC4; ++i) sum[i] = vec4(0.0);
  uint from[8];
  [[unroll]] for (uint a = 0u; a < 8u; ++a) from[a] = min(v + 8u * a, n - 1u) * stride;
  uint end = head_row(head + 1u, OFFSETS) / 4u;
  for (uint r = head_row(head, OFFSETS) / 4u; r < end; ++r) {
    vec4 g[8];
    [[unroll]] for (uint a = 0u; a < 8u; ++a) g[a] = grad_output[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      vec4 row = packed[FIRST_VEC4 + (4u * r + c) * ROW_VEC4 + lane];
      [[unroll]] for (uint q = 0u; q < ROW_VEC4; ++q) {
        vec4 w = subgroupShuffle(row, q);
        [[unroll]] for (uint a = 0u; a < 8u; ++a) sum[ROW_VEC4 * a + q] = add_scaled(sum[ROW_VEC4 * a + q], g[a][c], w);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < 8u; ++a) {
    if (v + 8u * a < n) {
      uint to = (v + 8u * a) * HIDDEN_VEC4 + ROW_VEC4 * head;
      [[unroll]] for (uint run = 0u; run < HIDDEN / UNITS; ++run) {
        uint bits = positive[(v + 8u * a) * POSITIVE + HIDDEN / UNITS * head + run];
        [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) {
          uint at = UNITS_VEC4 * run + q;
          grad_hidden[to + at] = mix(vec4(0.0), sum[ROW_VEC4 * a + at], positive_at(bits, q));
        }
      }
    }
  }
}
