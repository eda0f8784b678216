#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Gradient of one matrix, output gradient times input summed over one of 8 slices of the tokens; with a bias (behind
// the matrix) also the sum of the output gradient. A thread: 8 rows, 8 columns, one slice.
layout(local_size_x = 64) in;
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
const uint SLICES = 8u;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint tiles = (push.rows / 2u) * (push.columns / 2u);
  uint id = thread_index();
  if (n == 0u || id >= tiles * SLICES) return;
  uint slice = id / tiles, tile = id % tiles;
  uint row = 2u * (tile / (push.columns / 2u)), column = 2u * (tile % (push.columns / 2u));
  uint length = (n + SLICES - 1u) / SLICES;
  vec4 sum[8][2], total[2] = vec4[2](vec4(0.0), vec4(0.0));
  [[unroll]] for (uint r = 0u; r < 8u; r++) sum[r][0] = sum[r][1] = vec4(0.0);
  for (uint t = slice * length; t < min(slice * length + length, n); t++) {
    uint g = t * push.rows + row, x = t * push.columns + column;
    vec4 a[2] = vec4[2](grad_output[g], grad_output[g + 1u]);
    vec4 u = inputs[x], v = inputs[x + 1u];
    total[0] += a[0];
    total[1] += a[1];
    [[unroll]] for (uint r = 0u; r < 8u; r++) {
      sum[r][0] = fma(vec4(a[r / 4u][r % 4u]), u, sum[r][0]);
      sum[r][1] = fma(vec4(a[r / 4u][r % 4u]), v, sum[r][1]);
    }
  }
  uint at = slice * (4u * push.rows * push.columns + push.bias * push.rows);
  [[unroll]] for (uint r = 0u; r < 8u; r++) {
    partial[at + (4u * row + r) * push.columns + column] = sum[r][0];
    partial[at + (4u * row + r) * push.columns + column + 1u] = sum[r][1];
  }
  if (push.bias != 0u && column == 0u) {
    uint behind = at + 4u * push.rows * push.columns + row;
    partial[behind] = total[0];
    partial[behind + 1u] = total[1];
  }
}
