#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Queries-or-keys and values of one side's tokens. A workgroup: 32 tokens, 64 rows of one of the two matrices.
layout(local_size_x = 128) in;
#define ROWS 32u
#define COLUMNS 64u
#include "thread.glsl"
#include "attention.glsl"
#include "product.glsl"
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
uint first, last, matrix;
void put(uint run) {
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, feature[min(first + i / 2u, last) * TOKEN + 2u * run + i % 2u]);
  EACH(i, 2u * COLUMNS) put_right(i / 2u, i % 2u, weights[matrix + i / 2u * TOKEN + 2u * run + i % 2u]);
}
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint blocks = (n + ROWS - 1u) / ROWS, id = group_index();
  if (id >= blocks * 2u * HEADS) return;
  uint part = id / blocks, head = part % HEADS;
  bool values = part >= HEADS;
  first = ROWS * (id % blocks);
  last = n - 1u;
  matrix = (values ? push.to_v : push.to_qk) + head * COLUMNS * TOKEN;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(TOKEN / 2u, sum);
  uint token = first + 4u * block_row();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    uint at = (token + r) * INNER + head * HEAD + block_column();
    if (token + r < n && values) value[at] = sum[r];
    if (token + r < n && !values) qk[at] = sum[r];
  }
}
