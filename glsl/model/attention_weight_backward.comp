#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// Gradient of one matrix, output gradient times input summed over one of 8 slices of the tokens; with a bias (behind
// the matrix) also the sum of the output gradient. A workgroup: 32 rows, 32 columns, one slice.
layout(local_size_x = 64) in;
#define ROWS 32u
#define COLUMNS 32u
#include "thread.glsl"
#include "attention.glsl"
#include "product.glsl"
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };          // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer GradOutput { vec4 grad_output[]; }; // [capacity * rows / 4]
layout(binding = 2, scalar) readonly buffer Input { vec4 inputs[]; };           // [capacity * columns / 4]
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [8 * (4 * rows * columns + bias * rows)] slices of the matrix and its bias
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint rows;     // vec4 of an output
  uint columns;  // vec4 of an input
  uint bias;     // 1: a bias follows
} push;
const uint PARTS = 8u; // slices
uint begin, end, row, column; // tokens of the slice; vec4s of the block
void put(uint run) {
  EACH(i, RUN * ACROSS) {
    uint term = i / ACROSS, quad = i % ACROSS, token = begin + RUN * run + term;
    bool present = token < end;
    put_left_across(term, quad, present ? grad_output[token * push.rows + row + quad] : vec4(0.0));
    put_right_across(term, quad, present ? inputs[token * push.columns + column + quad] : vec4(0.0));
  }
}
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint across = push.columns / ACROSS, blocks = push.rows / ACROSS * across, id = group_index();
  if (n == 0u || id >= blocks * PARTS) return;
  uint part = id / blocks, length = (n + PARTS - 1u) / PARTS;
  row = ACROSS * (id % blocks / across);
  column = ACROSS * (id % blocks % across);
  begin = min(part * length, n);
  end = min(begin + length, n);
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product((end - begin + RUN - 1u) / RUN, sum);
  uint at = part * (4u * push.rows * push.columns + push.bias * push.rows);
  uint first = at + 4u * (row + block_row()) * push.columns + column + block_column();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) partial[first + r * push.columns] = sum[r];
  if (push.bias != 0u && column == 0u && gl_LocalInvocationID.x < ACROSS) {
    uint quad = row + gl_LocalInvocationID.x;
    vec4 total = vec4(0.0);
    for (uint t = begin; t < end; ++t) total += grad_output[t * push.rows + quad];
    partial[at + 4u * push.rows * push.columns + quad] = total;
  }
}
