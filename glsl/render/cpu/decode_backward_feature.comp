#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// As decode_backward_feature, for subgroups of 8 (CPU drivers): a subgroup takes 64 anchors, 8 in a lane, and of the weights
// each lane loads an eighth.
layout(local_size_x = 8) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };           // [V] anchors
layout(binding = 2, scalar) readonly buffer Packed { vec4 packed[]; };             // of decode_pack
layout(binding = 3, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; };    // [V*24] of decode_backward_hidden
layout(binding = 4, scalar) writeonly buffer GradFeature { vec4 grad_feature[]; }; // [N*8] visible anchors only
void main() {
  const uint ROW = FEATURE / 4u;
  uint lane = gl_SubgroupInvocationID, n = groups[3], v = LANES_ANCHORS * group_index() + lane;
  if (v - lane >= n) return;
  vec4 sum[8u * ROW];
  [[unroll]] for (uint i = 0u; i < 8u * ROW; ++i) sum[i] = vec4(0.0);
  uint from[8];
  [[unroll]] for (uint a = 0u; a < 8u; ++a) from[a] = min(v + 8u * a, n - 1u) * HIDDEN_VEC4;
  for (uint r = 0u; r < HIDDEN_VEC4; ++r) {
    vec4 g[8];
    [[unroll]] for (uint a = 0u; a < 8u; ++a) g[a] = grad_hidden[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      vec4 row = packed[(4u * r + c) * INPUT_VEC4 + lane];
      [[unroll]] for (uint q = 0u; q < ROW; ++q) {
        vec4 w = subgroupShuffle(row, q);
        [[unroll]] for (uint a = 0u; a < 8u; ++a) sum[ROW * a + q] = add_scaled(sum[ROW * a + q], g[a][c], w);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < 8u; ++a) {
    if (v + 8u * a < n) {
      uint to = visible[v + 8u * a] * ROW;
      [[unroll]] for (uint q = 0u; q < ROW; ++q) grad_feature[to + q] = sum[ROW * a + q];
    }
  }
}
