#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Gradient of one side's features through both its matrices. A workgroup: 16 tokens; each of 8 slices takes a quarter of the
// terms of one matrix.
layout(local_size_x = 256) in;
#define ROWS 16u
#define COLUMNS 32u
#define SLICES 8u
#include "thread.glsl"
#include "attention.glsl"
#include "product.glsl"
#include "slices.glsl"
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };              // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Weights { vec4 weights[]; };            // [24592] all weights
layout(binding = 2, scalar) readonly buffer GradQk { vec4 grad_qk[]; };             // [capacity * 128]
layout(binding = 3, scalar) readonly buffer GradValue { vec4 grad_value[]; };       // [capacity * 128]
layout(binding = 4, scalar) writeonly buffer GradFeature { vec4 grad_feature[]; };  // [capacity * 8]
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_qk;    // vec4 offset of the matrix (512, 32) in the weights
  uint to_v;     // vec4 offset of the matrix (512, 32) in the weights
} push;
const uint TERMS = 4u * INNER * 2u / SLICES; // of a slice
uint first, last;
void put(uint run) {
  uint slice = block_slice(), term = slice % (SLICES / 2u) * TERMS + RUN * run;
  bool values = slice >= SLICES / 2u;
  EACH(i, 2u * ROWS) {
    uint at = min(first + i / 2u, last) * INNER + term / 4u + i % 2u;
    put_left(i / 2u, i % 2u, values ? grad_value[at] : grad_qk[at]);
  }
  uint matrix = (values ? push.to_v : push.to_qk) + term * TOKEN;
  EACH(i, RUN * TOKEN) put_right_across(i / TOKEN, i % TOKEN, weights[matrix + i]);
}
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  first = ROWS * group_index();
  if (first >= n) return;
  last = n - 1u;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(TERMS / RUN, sum);
  add_slices(sum);
  uint token = first + 4u * block_row();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    if (block_slice() == 0u && token + r < n) grad_feature[(token + r) * TOKEN + block_column()] = sum[r];
  }
}
