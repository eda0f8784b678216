#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// What the gradients need of every pair of tokens, kept in matrices of all heads, in rows of the token around.
//
// Token i inside, j around, in one head: s_ij = qk_i . qk_j / 8 serves both directions,
//   mixed_i = sum_j p_ij value_j, p_ij = exp(s_ij - top_i) / sum_i,   mixed_j = sum_i r_ij value_i, r_ij = exp(s_ij - top_j) / sum_j.
// A softmax passes p_ij (a_ij - sum_k p_ik a_ik) back with a_ij = dL/dmixed_i . value_j, and the sum over k is
// dL/dmixed_i . mixed_i. With b_ij = dL/dmixed_j . value_i likewise:
//   dL/ds_ij = p_ij (a_ij - dL/dmixed_i . mixed_i) + r_ij (b_ij - dL/dmixed_j . mixed_j).
// `rows` holds top, 1 / sum and dL/dmixed . mixed of each token, `grad_s` an eighth of dL/ds: what multiplies qk.
//
// Threads: a subgroup of 8 (CPU drivers) takes 32 tokens inside, 4 neighbours in a lane's registers (query, value, gradient,
// row), and goes over all tokens around, 8 at a time: each lane loads one, shuffles hand them round, and a lane writes its
// 4 pairs of each as one vec4. The loop over the 8 is not unrolled: its body would no longer fit into the cache of
// instructions.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                     // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Qk { vec4 qk[]; };                             // [capacity * 128] inside
layout(binding = 2, scalar) readonly buffer Value { vec4 value[]; };                       // [capacity * 128] inside
layout(binding = 3, scalar) readonly buffer GradMixed { vec4 grad_mixed[]; };              // [capacity * 128] inside
layout(binding = 4, scalar) readonly buffer Rows { vec3 rows[]; };                         // [capacity * 8] inside
layout(binding = 5, scalar) readonly buffer OtherQk { vec4 other_qk[]; };                  // [capacity * 128] around
layout(binding = 6, scalar) readonly buffer OtherValue { vec4 other_value[]; };            // [capacity * 128] around
layout(binding = 7, scalar) readonly buffer OtherGradMixed { vec4 other_grad_mixed[]; };   // [capacity * 128] around
layout(binding = 8, scalar) readonly buffer OtherRows { vec3 other_rows[]; };              // [capacity * 8] around
layout(binding = 9, scalar) writeonly buffer Inside { vec4 inside_share[]; };             // [8 * capacity * stride] p
layout(binding = 10, scalar) writeonly buffer Around { vec4 around_share[]; };            // [8 * capacity * stride] r
layout(binding = 11, scalar) writeonly buffer GradS { vec4 grad_s[]; };                   // [8 * capacity * stride] an eighth
layout(push_constant, scalar) uniform Push {
  uint capacity; // tokens of a side at most
  uint stride;   // vec4 of a row: a token around, all tokens inside
} push;
void main() {
  uvec2 n = sides(tokens[0], tokens[1], push.capacity);
  uint blocks = (n.x + 31u) / 32u;
  uint id = group_index();
  if (id >= blocks * HEADS) return;
  uint lane = gl_SubgroupInvocationID;
  uint h = id / blocks, head = h * HEAD, first = (id % blocks) * 32u + 4u * lane;
  uint stride = push.stride, to = h * push.capacity * stride + first / 4u;
  vec4 query[4][16], own_value[4][16], own_grad[4][16]; // of tokens first to first + 3; the query already an eighth
  vec3 row[4]; // top, 1 / sum, dL/dmixed . mixed
  [[unroll]] for (uint r = 0u; r < 4u; r++) {
    [[unroll]] for (uint d = 0u; d < 16u; d++) query[r][d] = own_value[r][d] = own_grad[r][d] = vec4(0.0);
    row[r] = vec3(0.0);
  }
  // A loop whose length the compiler does not know: llvmpipe makes a loop of every load, and its compiler's time grows
  // with the square of their number.
  for (uint i = 0u; i < min(4u, n.x * HEADS); i++) {
    uint token = min(first + i, n.x - 1u), at = token * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 next_query = 0.125 * qk[at + d], next_value = value[at + d], next_grad = grad_mixed[at + d];
      [[unroll]] for (uint r = 0u; r < 4u; r++) {
        query[r][d] = i == r ? next_query : query[r][d];
        own_value[r][d] = i == r ? next_value : own_value[r][d];
        own_grad[r][d] = i == r ? next_grad : own_grad[r][d];
      }
    }
    vec3 own_row = rows[token * HEADS + h];
    [[unroll]] for (uint r = 0u; r < 4u; r++) row[r] = i == r ? own_row : row[r];
  }
  for (uint j = 0u; j < n.y; j += 8u) {
    uint token = min(j + lane, n.y - 1u), at = token * INNER + head;
    vec3 their_row = other_rows[token * HEADS + h];
    vec4 their_qk[16], their_value[16], their_grad[16];
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      their_qk[d] = other_qk[at + d];
      their_value[d] = other_value[at + d];
      their_grad[d] = other_grad_mixed[at + d];
    }
    for (uint c = 0u; c < min(8u, n.y - j); c++, to += stride) {
      vec3 other = subgroupShuffle(their_row, c);
      vec4 sum[4], p, r, s;
      float logit[4], a[4];
      [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = vec4(0.0);
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 k = subgroupShuffle(their_qk[d], c);
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(query[i][d], k, sum[i]);
      }
      [[unroll]] for (uint i = 0u; i < 4u; i++) {
        logit[i] = sum4(sum[i]);
        sum[i] = vec4(0.0);
      }
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 w = subgroupShuffle(their_value[d], c);
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(own_grad[i][d], w, sum[i]);
      }
      [[unroll]] for (uint i = 0u; i < 4u; i++) {
        a[i] = sum4(sum[i]);
        sum[i] = vec4(0.0);
      }
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 e = subgroupShuffle(their_grad[d], c);
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(own_value[i][d], e, sum[i]);
      }
      [[unroll]] for (uint i = 0u; i < 4u; i++) {
        bool present = first + i < n.x; // behind the last token it is repeated
        // The forward pass formed the logits by the same operations: neither exponent is positive.
        p[i] = present ? exp(logit[i] - row[i].x) * row[i].y : 0.0;
        r[i] = present ? exp(logit[i] - other.x) * other.y : 0.0;
        s[i] = present ? 0.125 * (p[i] * (a[i] - row[i].z) + r[i] * (sum4(sum[i]) - other.z)) : 0.0;
      }
      if (first < n.x) {
        inside_share[to] = p;
        around_share[to] = r;
        grad_s[to] = s;
      }
    }
  }
}
