#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Output projection of one side: (32, 512) and bias. A workgroup: 16 tokens; each of 8 slices takes the terms of a head.
layout(local_size_x = 256) in;
#define ROWS 16u
#define COLUMNS 32u
#define SLICES 8u
#include "thread.glsl"
#include "attention.glsl"
#include "product.glsl"
#include "slices.glsl"
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Mixed { vec4 mixed[]; };        // [capacity * 128] attended values
layout(binding = 2, scalar) readonly buffer Weights { vec4 weights[]; };    // [24592] all weights
layout(binding = 3, scalar) writeonly buffer Updated { vec4 updated[]; };   // [capacity * 8] attended features
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_out;   // vec4 offset of the matrix (32, 512) in the weights, its bias behind it
} push;
uint first, last;
void put(uint run) {
  uint from = block_slice() * HEAD + 2u * run;
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, mixed[min(first + i / 2u, last) * INNER + from + i % 2u]);
  EACH(i, 2u * COLUMNS) put_right(i / 2u, i % 2u, weights[push.to_out + i / 2u * INNER + from + i % 2u]);
}
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  first = ROWS * group_index();
  if (first >= n) return;
  last = n - 1u;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(HEAD / 2u, sum);
  add_slices(sum);
  uint token = first + 4u * block_row();
  vec4 bias = weights[push.to_out + COLUMNS * INNER + block_column()];
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    if (block_slice() == 0u && token + r < n) updated[(token + r) * TOKEN + block_column()] = sum[r] + bias;
  }
}
