#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// What the gradients need of every pair of tokens, kept in matrices of all heads: with p, r and grad_s as in
// attention_backward, token i inside, token j around,  p_ij,  r_ij  and  grad_s_ij / 8  in rows of j. For subgroups of 8
// (CPU drivers): a subgroup takes 32 tokens inside, 4 neighbours in a lane, and 8 tokens around at a time, of which each
// lane loads one. The loop over these is not unrolled: its body would no longer fit into the cache of instructions.
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
  vec4 q[4][16], v[4][16], g[4][16];
  vec3 row[4];
  [[unroll]] for (uint r = 0u; r < 4u; r++) {
    [[unroll]] for (uint d = 0u; d < 16u; d++) q[r][d] = v[r][d] = g[r][d] = vec4(0.0);
    row[r] = vec3(0.0);
  }
  // A loop whose length the compiler does not know: llvmpipe makes a loop of every load, and its compiler's time grows
  // with the square of their number.
  for (uint i = 0u; i < min(4u, n.x * HEADS); i++) {
    uint token = min(first + i, n.x - 1u), at = token * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 own_qk = 0.125 * qk[at + d], own_value = value[at + d], own_grad = grad_mixed[at + d];
      [[unroll]] for (uint r = 0u; r < 4u; r++) {
        q[r][d] = i == r ? own_qk : q[r][d];
        v[r][d] = i == r ? own_value : v[r][d];
        g[r][d] = i == r ? own_grad : g[r][d];
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
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(q[i][d], k, sum[i]);
      }
      [[unroll]] for (uint i = 0u; i < 4u; i++) {
        logit[i] = sum4(sum[i]);
        sum[i] = vec4(0.0);
      }
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 w = subgroupShuffle(their_value[d], c);
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(g[i][d], w, sum[i]);
      }
      [[unroll]] for (uint i = 0u; i < 4u; i++) {
        a[i] = sum4(sum[i]);
        sum[i] = vec4(0.0);
      }
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 e = subgroupShuffle(their_grad[d], c);
        [[unroll]] for (uint i = 0u; i < 4u; i++) sum[i] = fma(v[i][d], e, sum[i]);
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
