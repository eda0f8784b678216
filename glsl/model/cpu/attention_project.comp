#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// As attention_project, for subgroups of 8 (CPU drivers): a subgroup takes 32 tokens, 4 in a lane, and 64 rows of one of
// the two matrices, 8 at a time, of which each lane loads one.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Feature { vec4 feature[]; };    // [capacity * 8] features of the side's tokens
layout(binding = 2, scalar) readonly buffer Weights { vec4 weights[]; };    // [24592] all weights
layout(binding = 3, scalar) writeonly buffer Qk { vec4 qk[]; };             // [capacity * 128] 8 heads of 64
layout(binding = 4, scalar) writeonly buffer Value { vec4 value[]; };       // [capacity * 128] 8 heads of 64
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
  if (id >= blocks * 16u) return;
  uint part = id / blocks, lane = gl_SubgroupInvocationID, first = (id % blocks) * 32u + lane;
  vec4 f[4][8];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = min(first + 8u * t, n - 1u) * TOKEN;
    [[unroll]] for (uint d = 0u; d < 8u; d++) f[t][d] = feature[at + d];
  }
  bool values = part >= 8u;
  uint begin = (part % 8u) * 64u;
  uint matrix = values ? push.to_v : push.to_qk;
  for (uint row = begin; row < begin + 64u; row += 8u) {
    vec4 w[8];
    [[unroll]] for (uint d = 0u; d < 8u; d++) w[d] = weights[matrix + (row + lane) * TOKEN + d];
    float y[4][8];
    [[unroll]] for (uint c = 0u; c < 8u; c++) {
      vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
      [[unroll]] for (uint d = 0u; d < 8u; d++) {
        vec4 u = subgroupShuffle(w[d], c);
        [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t] = fma(u, f[t][d], sum[t]);
      }
      [[unroll]] for (uint t = 0u; t < 4u; t++) y[t][c] = sum4(sum[t]);
    }
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      uint at = (first + 8u * t) * INNER + row / 4u;
      vec4 a = vec4(y[t][0], y[t][1], y[t][2], y[t][3]), b = vec4(y[t][4], y[t][5], y[t][6], y[t][7]);
      bool present = first + 8u * t < n;
      if (present && values) {
        value[at] = a;
        value[at + 1u] = b;
      }
      if (present && !values) {
        qk[at] = a;
        qk[at + 1u] = b;
      }
    }
  }
}
