#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Output projection of one side: (32, 512) and bias. A thread: 4 tokens, 4 features.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Mixed { vec4 mixed[]; };        // [capacity * 128] attended values
layout(binding = 2, scalar) readonly buffer Weights { vec4 weights[]; };    // [24592] all weights
layout(binding = 3, scalar) writeonly buffer Updated { vec4 updated[]; };   // [capacity * 8] attended features
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  uint to_out;   // vec4 offset of the matrix (32, 512) in the weights, its bias behind it
} push;
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint quads = (n + 3u) / 4u;
  uint id = thread_index();
  if (id >= quads * TOKEN) return;
  uint row = id / quads, first = 4u * (id % quads);
  uint at[4];
  vec4 sum[4][4];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    at[t] = min(first + t, n - 1u) * INNER;
    [[unroll]] for (uint r = 0u; r < 4u; r++) sum[t][r] = vec4(0.0);
  }
  uint matrix = push.to_out + 4u * row * INNER;
  for (uint c = 0u; c < INNER; c += 2u) {
    [[unroll]] for (uint k = c; k < c + 2u; k++) {
      vec4 x[4];
      [[unroll]] for (uint t = 0u; t < 4u; t++) x[t] = mixed[at[t] + k];
      [[unroll]] for (uint r = 0u; r < 4u; r++) {
        vec4 w = weights[matrix + r * INNER + k];
        [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t][r] = fma(w, x[t], sum[t][r]);
      }
    }
  }
  vec4 bias = weights[push.to_out + 32u * INNER + row];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    vec4 y = vec4(sum4(sum[t][0]), sum4(sum[t][1]), sum4(sum[t][2]), sum4(sum[t][3]));
    if (first + t < n) updated[(first + t) * TOKEN + row] = y + bias;
  }
}
