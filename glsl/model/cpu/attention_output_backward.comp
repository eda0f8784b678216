#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// As attention_output_backward, for subgroups of 8 (CPU drivers): a subgroup takes 32 tokens, 4 in a lane, of one head;
// each lane loads 4 of the 32 rows.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };              // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer GradUpdated { vec4 grad_updated[]; };   // [capacity * 8]
layout(binding = 2, scalar) readonly buffer Weights { vec4 weights[]; };            // [24592] all weights
layout(binding = 3, scalar) readonly buffer Mixed { vec4 mixed[]; };                // [capacity * 128] attended values
layout(binding = 4, scalar) readonly buffer Softmax { vec2 softmax[]; };            // [capacity * 8] largest logit, 1 / sum of exp
layout(binding = 5, scalar) writeonly buffer GradMixed { vec4 grad_mixed[]; };      // [capacity * 128]
layout(binding = 6, scalar) writeonly buffer Rows { vec3 rows[]; };                 // [capacity * 8] largest logit, 1 / sum of exp, product
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_out;   // vec4 offset of the matrix (32, 512) in the weights
} push;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint blocks = (n + 31u) / 32u;
  uint id = group_index();
  if (id >= blocks * HEADS) return;
  uint lane = gl_SubgroupInvocationID, head = id / blocks, first = (id % blocks) * 32u + lane;
  vec4 g[4][8], product[4];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = min(first + 8u * t, n - 1u) * TOKEN;
    [[unroll]] for (uint d = 0u; d < 8u; d++) g[t][d] = grad_updated[at + d];
    product[t] = vec4(0.0);
  }
  for (uint c = head * HEAD; c < head * HEAD + HEAD; c++) {
    vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
    [[unroll]] for (uint k = 0u; k < 4u; k++) {
      vec4 mine = weights[push.to_out + (8u * k + lane) * INNER + c], w[8];
      [[unroll]] for (uint r = 0u; r < 8u; r++) w[r] = subgroupShuffle(mine, r);
      [[unroll]] for (uint t = 0u; t < 4u; t++) {
        vec4 a = g[t][2u * k], b = g[t][2u * k + 1u];
        sum[t] += times8(float[8](a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w), w);
      }
    }
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      uint at = min(first + 8u * t, n - 1u) * INNER + c;
      product[t] = fma(sum[t], mixed[at], product[t]);
      if (first + 8u * t < n) grad_mixed[at] = sum[t];
    }
  }
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = (first + 8u * t) * HEADS + head;
    if (first + 8u * t < n) rows[at] = vec3(softmax[at], sum4(product[t]));
  }
}
