#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// As attention_project_backward, for subgroups of 8 (CPU drivers): a subgroup takes 32 tokens, 4 in a lane, and 16
// features; of 8 rows of a matrix at a time each lane loads one.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };              // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Weights { vec4 weights[]; };            // [24592] all weights
layout(binding = 2, scalar) readonly buffer GradQk { vec4 grad_qk[]; };             // [capacity * 128]
layout(binding = 3, scalar) readonly buffer GradValue { vec4 grad_value[]; };       // [capacity * 128]
layout(binding = 4, scalar) writeonly buffer GradFeature { vec4 grad_feature[]; };  // [capacity * 8]
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_qk;    // vec4 offset of the matrix (512, 32) in the weights
  uint to_v;     // vec4 offset of the matrix (512, 32) in the weights
} push;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint blocks = (n + 31u) / 32u;
  uint id = group_index();
  if (id >= blocks * 2u) return;
  uint lane = gl_SubgroupInvocationID, column = (id / blocks) * 4u, first = (id % blocks) * 32u + lane;
  uint at[4];
  vec4 sum[4][4];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    at[t] = min(first + 8u * t, n - 1u) * INNER;
    [[unroll]] for (uint d = 0u; d < 4u; d++) sum[t][d] = vec4(0.0);
  }
  uint a = push.to_qk + lane * TOKEN + column, b = push.to_v + lane * TOKEN + column;
  for (uint c = 0u; c < INNER; c += 2u) {
    float x[4][8], y[4][8];
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      vec4 p = grad_qk[at[t] + c], q = grad_qk[at[t] + c + 1u];
      x[t] = float[8](p.x, p.y, p.z, p.w, q.x, q.y, q.z, q.w);
      p = grad_value[at[t] + c];
      q = grad_value[at[t] + c + 1u];
      y[t] = float[8](p.x, p.y, p.z, p.w, q.x, q.y, q.z, q.w);
    }
    [[unroll]] for (uint d = 0u; d < 4u; d++) {
      vec4 their_u = weights[a + 4u * c * TOKEN + d], their_w = weights[b + 4u * c * TOKEN + d], u[8], w[8];
      [[unroll]] for (uint r = 0u; r < 8u; r++) {
        u[r] = subgroupShuffle(their_u, r);
        w[r] = subgroupShuffle(their_w, r);
      }
      [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t][d] += times8(x[t], u) + times8(y[t], w);
    }
  }
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    [[unroll]] for (uint d = 0u; d < 4u; d++) {
      if (first + 8u * t < n) grad_feature[(first + 8u * t) * TOKEN + column + d] = sum[t][d];
    }
  }
}
