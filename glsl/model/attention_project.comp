#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Queries-or-keys and values of one side's tokens. A thread: 4 tokens, 32 rows of one of the two matrices.
layout(local_size_x = 64) in;
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
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint quads = (n + 3u) / 4u;
  uint id = thread_index();
  if (id >= quads * 32u) return;
  uint part = id / quads, first = 4u * (id % quads);
  vec4 f[4][8];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = min(first + t, n - 1u) * TOKEN;
    [[unroll]] for (uint d = 0u; d < 8u; d++) f[t][d] = feature[at + d];
  }
  bool values = part >= 16u;
  uint rows = (part % 16u) * 8u; // vec4 of rows
  uint matrix = values ? push.to_v : push.to_qk;
  for (uint row = rows; row < rows + 8u; row++) {
    vec4 result[4];
    [[unroll]] for (uint r = 0u; r < 4u; r++) {
      vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
      [[unroll]] for (uint d = 0u; d < 8u; d++) {
        vec4 w = weights[matrix + (4u * row + r) * TOKEN + d];
        [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t] = fma(w, f[t][d], sum[t]);
      }
      [[unroll]] for (uint t = 0u; t < 4u; t++) result[t][r] = sum4(sum[t]);
    }
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      if (first + t < n) {
        uint at = (first + t) * INNER + row;
        if (values) value[at] = result[t]; else qk[at] = result[t];
      }
    }
  }
}
