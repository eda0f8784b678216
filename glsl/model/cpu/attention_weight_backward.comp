#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// Gradient of one matrix, output gradient times input summed over the tokens; with a bias (behind the matrix) also the sum
// of the output gradient. For subgroups of 8 (CPU drivers): a subgroup takes 32 rows, 4 in a lane, and 32 columns, of
// which each lane loads 4; 8 tokens at a time are summed as a tree. No tokens: a gradient of zero.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                 // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer GradOutput { vec4 grad_output[]; };        // [capacity * rows / 4]
layout(binding = 2, scalar) readonly buffer Input { vec4 inputs[]; };                  // [capacity * columns / 4]
layout(binding = 3, scalar) writeonly buffer GradWeights { vec4 grad_weights[]; };     // [24592] of which one matrix is written
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint rows;     // vec4 of an output
  uint columns;  // vec4 of an input
  uint bias;     // 1: a bias follows
  uint matrix;   // vec4 offset of the matrix in the weights
} push;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint across = push.columns / 8u;
  uint id = group_index();
  if (id >= push.rows / 8u * across) return;
  uint lane = gl_SubgroupInvocationID, row = (id / across) * 8u + lane, column = (id % across) * 8u;
  vec4 sum[32], total = vec4(0.0); // of 4 rows for each column
  [[unroll]] for (uint k = 0u; k < 32u; k++) sum[k] = vec4(0.0);
  for (uint t = 0u; t < n; t += 8u) {
    vec4 g[8], x[8];
    [[unroll]] for (uint k = 0u; k < 8u; k++) {
      uint at = min(t + k, n - 1u);
      g[k] = t + k < n ? grad_output[at * push.rows + row] : vec4(0.0);
      x[k] = inputs[at * push.columns + column + lane];
    }
    total += ((g[0] + g[1]) + (g[2] + g[3])) + ((g[4] + g[5]) + (g[6] + g[7]));
    [[unroll]] for (uint c = 0u; c < 32u; c++) {
      float u[8];
      [[unroll]] for (uint k = 0u; k < 8u; k++) u[k] = subgroupShuffle(x[k][c % 4u], c / 4u);
      sum[c] += times8(u, g);
    }
  }
  [[unroll]] for (uint r = 0u; r < 4u; r++) {
    [[unroll]] for (uint q = 0u; q < 8u; q++) {
      vec4 y = vec4(sum[4u * q][r], sum[4u * q + 1u][r], sum[4u * q + 2u][r], sum[4u * q + 3u][r]);
      grad_weights[push.matrix + (4u * row + r) * push.columns + column + q] = y;
    }
  }
  if (push.bias != 0u && column == 0u) grad_weights[push.matrix + 4u * push.rows * push.columns + row] = total;
}
