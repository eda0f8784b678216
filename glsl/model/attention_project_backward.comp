#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Gradient of one side's features through both its matrices. A thread: 4 tokens, 4 features.
layout(local_size_x = 64) in;
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
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint quads = (n + 3u) / 4u;
  uint id = thread_index();
  if (id >= quads * TOKEN) return;
  uint column = id / quads, first = 4u * (id % quads);
  uint at[4];
  vec4 sum[2][4];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    at[t] = min(first + t, n - 1u) * INNER;
    sum[0][t] = sum[1][t] = vec4(0.0);
  }
  uint a = push.to_qk + column, b = push.to_v + column;
  for (uint c = 0u; c < INNER; c++) {
    vec4 x[4], y[4];
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      x[t] = grad_qk[at[t] + c];
      y[t] = grad_value[at[t] + c];
    }
    [[unroll]] for (uint r = 0u; r < 4u; r++) {
      vec4 u = weights[a + (4u * c + r) * TOKEN], w = weights[b + (4u * c + r) * TOKEN];
      [[unroll]] for (uint t = 0u; t < 4u; t++) {
        sum[0][t] = fma(vec4(x[t][r]), u, sum[0][t]);
        sum[1][t] = fma(vec4(y[t][r]), w, sum[1][t]);
      }
    }
  }
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    if (first + t < n) grad_feature[(first + t) * TOKEN + column] = sum[0][t] + sum[1][t];
  }
}
