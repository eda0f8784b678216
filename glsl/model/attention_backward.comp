#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Gradients of one side's queries and values, through both directions at once: with similarity s_ij, own token i, other
// token j,  p_ij = exp(s_ij - top_i) / sum_i  attends from i,  r_ij = exp(s_ij - top_j) / sum_j  attends from j, and
//   grad_s_ij = p_ij (grad_mixed_i . value_j - product_i) + r_ij (grad_mixed_j . value_i - product_j),
//   grad_qk_i = 1/8 sum_j grad_s_ij qk_j,   grad_value_i = sum_j r_ij grad_mixed_j.
// A workgroup: 32 tokens of one head, 32 others at a time. Every output has one owner and one order of summation.
layout(local_size_x = 128) in;
#include "thread.glsl"
#include "attention.glsl"
#include "attention_tile.glsl"
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
shared vec4 grad_s[TILE * STRIDE]; // by other, then by own token
shared vec4 shares[TILE * STRIDE]; // likewise, of the others: r
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + TILE - 1u) / TILE, id = group_index();
  if (id >= blocks * HEADS) return;
  uint h = id / blocks, head = h * HEAD, first = TILE * (id % blocks), row = own_row(), column = other_column();
  vec4 gq[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)), gv[4] = gq;
  vec4 top, inverse, product;
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    vec3 own = rows[min(first + 4u * row + r, n.x - 1u) * HEADS + h];
    top[r] = own.x;
    inverse[r] = own.y;
    product[r] = own.z;
  }
  for (uint from = 0u; from < n.y; from += TILE) {
    vec4 p[2], r[2], dot_[2];
    TILE_PRODUCTS(dot_, qk, first, n.x - 1u, other_qk, from, n.y - 1u, head)
    vec3 other[2];
    [[unroll]] for (uint i = 0u; i < 2u; ++i) {
      uint j = from + column + 16u * i;
      other[i] = other_rows[min(j, n.y - 1u) * HEADS + h];
      // The forward pass formed the logits by the same operations: neither exponent is positive.
      vec4 logit = 0.125 * dot_[i];
      p[i] = exp(logit - top) * inverse;
      r[i] = exp(logit - other[i].x) * other[i].y;
      if (j >= n.y) p[i] = r[i] = vec4(0.0);
      shares[(column + 16u * i) * STRIDE + row] = r[i];
    }
    TILE_PRODUCTS(dot_, grad_mixed, first, n.x - 1u, other_value, from, n.y - 1u, head)
    [[unroll]] for (uint i = 0u; i < 2u; ++i) p[i] *= dot_[i] - product;
    TILE_PRODUCTS(dot_, value, first, n.x - 1u, other_grad_mixed, from, n.y - 1u, head)
    [[unroll]] for (uint i = 0u; i < 2u; ++i)
      grad_s[(column + 16u * i) * STRIDE + row] = p[i] + r[i] * (dot_[i] - other[i].z);
    for (uint k = 0u; k < TILE; k += RUN) {
      uint at = min(from + k + gl_LocalInvocationID.x / HEAD, n.y - 1u) * INNER + head + column;
      barrier();
      run_own[gl_LocalInvocationID.x] = other_qk[at];
      run_other[gl_LocalInvocationID.x] = other_grad_mixed[at];
      barrier();
      [[unroll]] for (uint i = 0u; i < RUN; ++i) {
        vec4 s = grad_s[(k + i) * STRIDE + row], w = shares[(k + i) * STRIDE + row];
        vec4 q = run_own[i * HEAD + column], g = run_other[i * HEAD + column];
        [[unroll]] for (uint t = 0u; t < 4u; ++t) {
          gq[t] = fma(vec4(s[t]), q, gq[t]);
          gv[t] = fma(vec4(w[t]), g, gv[t]);
        }
      }
    }
  }
  [[unroll]] for (uint t = 0u; t < 4u; ++t) {
    uint token = first + 4u * row + t, at = token * INNER + head + column;
    if (token < n.x) {
      grad_qk[at] = 0.125 * gq[t];
      grad_value[at] = gv[t];
    }
  }
}
