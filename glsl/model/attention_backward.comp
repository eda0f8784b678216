#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Gradients of one side's queries and values, through both directions at once: with similarity s_ij, own token i, other
// token j,  p_ij = exp(s_ij - top_i) / sum_i  attends from i,  r_ij = exp(s_ij - top_j) / sum_j  attends from j, and
//   grad_s_ij = p_ij (grad_mixed_i . value_j - product_i) + r_ij (grad_mixed_j . value_i - product_j),
//   grad_qk_i = 1/8 sum_j grad_s_ij qk_j,   grad_value_i = sum_j r_ij grad_mixed_j.
// A thread: QUERIES tokens of one head. Every output has one owner and one order of summation.
#ifndef QUERIES
#define QUERIES 1
#endif
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                     // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Qk { vec4 qk[]; };                             // [capacity * 128] own
layout(binding = 2, scalar) readonly buffer Value { vec4 value[]; };                       // [capacity * 128] own
layout(binding = 3, scalar) readonly buffer GradMixed { vec4 grad_mixed[]; };              // [capacity * 128] own
layout(binding = 4, scalar) readonly buffer Rows { vec3 rows[]; };                         // [capacity * 8] own
layout(binding = 5, scalar) readonly buffer OtherQk { vec4 other_qk[]; };                  // [capacity * 128]
layout(binding = 6, scalar) readonly buffer OtherValue { vec4 other_value[]; };            // [capacity * 128]
layout(binding = 7, scalar) readonly buffer OtherGradMixed { vec4 other_grad_mixed[]; };   // [capacity * 128]
layout(binding = 8, scalar) readonly buffer OtherRows { vec3 other_rows[]; };              // [capacity * 8]
layout(binding = 9, scalar) writeonly buffer GradQk { vec4 grad_qk[]; };                   // [capacity * 128] own
layout(binding = 10, scalar) writeonly buffer GradValue { vec4 grad_value[]; };            // [capacity * 128] own
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens of a side at most
} push;
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + QUERIES - 1u) / QUERIES;
  uint id = thread_index();
  if (id >= blocks * HEADS) return;
  uint h = id / blocks, head = h * HEAD, block = id % blocks;
  vec4 q[QUERIES][16], v[QUERIES][16], g[QUERIES][16], gq[QUERIES][16], gv[QUERIES][16];
  vec3 row[QUERIES];
  [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
    uint token = min(i * blocks + block, n.x - 1u), at = token * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      q[i][d] = 0.125 * qk[at + d];
      v[i][d] = value[at + d];
      g[i][d] = grad_mixed[at + d];
      gq[i][d] = gv[i][d] = vec4(0.0);
    }
    row[i] = rows[token * HEADS + h];
  }
  for (uint j = 0u; j < n.y; j++) {
    uint at = j * INNER + head;
    vec3 other = other_rows[j * HEADS + h];
    vec4 s[QUERIES], a[QUERIES], b[QUERIES];
    [[unroll]] for (uint i = 0u; i < QUERIES; i++) s[i] = a[i] = b[i] = vec4(0.0);
    vec4 k[16], c[16];
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      k[d] = other_qk[at + d];
      c[d] = other_grad_mixed[at + d];
      vec4 w = other_value[at + d];
      [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
        s[i] = fma(q[i][d], k[d], s[i]);
        a[i] = fma(g[i][d], w, a[i]);
        b[i] = fma(v[i][d], c[d], b[i]);
      }
    }
    [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
      float logit = sum4(s[i]);
      // The forward pass formed the logits by the same operations: neither exponent is positive.
      float p = exp(logit - row[i].x) * row[i].y, r = exp(logit - other.x) * other.y;
      float grad = p * (sum4(a[i]) - row[i].z) + r * (sum4(b[i]) - other.z);
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        gq[i][d] = fma(vec4(grad), k[d], gq[i][d]);
        gv[i][d] = fma(vec4(r), c[d], gv[i][d]);
      }
    }
  }
  [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
    uint token = i * blocks + block, at = token * INNER + head;
    if (token < n.x) {
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        grad_qk[at + d] = 0.125 * gq[i][d];
        grad_value[at + d] = gv[i][d];
      }
    }
  }
}
