#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// As attention_output, for subgroups of 8 (CPU drivers): a subgroup takes 32 tokens, 4 in a lane, and 16 features, of
// whose rows each lane loads two.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Mixed { vec4 mixed[]; };        // [capacity * 128] attended values
layout(binding = 2, scalar) readonly buffer Weights { vec4 weights[]; };    // [24592] all weights
layout(binding = 3, scalar) writeonly buffer Updated { vec4 updated[]; };   // [capacity * 8] attended features
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_out;   // vec4 offset of the matrix (32, 512) in the weights, its bias behind it
} push;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint blocks = (n + 31u) / 32u;
  uint id = group_index();
  if (id >= blocks * 2u) return;
  uint lane = gl_SubgroupInvocationID, row = (id / blocks) * 16u, first = (id % blocks) * 32u + lane;
  uint at[4];
  float sum[4][16];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    at[t] = min(first + 8u * t, n - 1u) * INNER;
    [[unroll]] for (uint r = 0u; r < 16u; r++) sum[t][r] = 0.0;
  }
  uint matrix = push.to_out + (row + lane) * INNER;
  for (uint k = 0u; k < INNER; k++) {
    vec4 x[4], w[2] = vec4[2](weights[matrix + k], weights[matrix + 8u * INNER + k]);
    [[unroll]] for (uint t = 0u; t < 4u; t++) x[t] = mixed[at[t] + k];
    [[unroll]] for (uint r = 0u; r < 16u; r++) {
      vec4 u = subgroupShuffle(w[r / 8u], r % 8u);
      [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t][r] += sum4(u * x[t]);
    }
  }
  uint bias = push.to_out + 32u * INNER + row / 4u;
  [[unroll]] for (uint q = 0u; q < 4u; q++) {
    vec4 b = weights[bias + q];
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      vec4 y = vec4(sum[t][4u * q], sum[t][4u * q + 1u], sum[t][4u * q + 2u], sum[t][4u * q + 3u]);
      if (first + 8u * t < n) updated[(first + 8u * t) * TOKEN + row / 4u + q] = y + b;
    }
  }
}
