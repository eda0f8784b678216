#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Gradient of one side's attended values, and its scalar product with them (the softmax's gradient needs it, as in
// FlashAttention, Dao et al. 2022). A workgroup: 32 tokens, one head.
layout(local_size_x = 128) in;
#define ROWS 32u
#define COLUMNS 64u
#include "thread.glsl"
#include "attention.glsl"
#include "product.glsl"
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
shared vec4 products[ROWS / 4u][ACROSS / 2u]; // of four rows and a run of eight columns
uint first, last, matrix;
void put(uint run) {
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, grad_updated[min(first + i / 2u, last) * TOKEN + 2u * run + i % 2u]);
  EACH(i, RUN * ACROSS)
    put_right_across(i / ACROSS, i % ACROSS, weights[matrix + (RUN * run + i / ACROSS) * INNER + i % ACROSS]);
}
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint blocks = (n + ROWS - 1u) / ROWS, id = group_index();
  if (id >= blocks * HEADS) return;
  uint head = id / blocks;
  first = ROWS * (id % blocks);
  last = n - 1u;
  matrix = push.to_out + head * HEAD;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(TOKEN / 2u, sum);
  // The terms in attention_backward's order, which takes the product from one that equals it where a share is 1: their
  // difference is 0 then, not a rounding. A run of 8 begins with one thread's columns and goes on with its neighbour's.
  uint row = block_row(), column = block_column(), token = first + 4u * row;
  for (uint turn = 0u; turn < 2u; ++turn) {
    if (column % 2u == turn) {
      vec4 part = turn == 0u ? vec4(0.0) : products[row][column / 2u];
      [[unroll]] for (uint r = 0u; r < 4u; ++r) {
        uint at = min(token + r, last) * INNER + head * HEAD + column;
        vec4 m = mixed[at];
        [[unroll]] for (uint c = 0u; c < 4u; ++c) part[r] = fma(sum[r][c], m[c], part[r]);
        if (token + r < n) grad_mixed[at] = sum[r];
      }
      products[row][column / 2u] = part;
    }
    barrier();
  }
  if (column >= 4u || token + column >= n) return;
  float total = 0.0;
  for (uint run = 0u; run < ACROSS / 2u; ++run) total += products[row][run][column];
  uint at = (token + column) * HEADS + head;
  rows[at] = vec3(softmax[at], total);
}
