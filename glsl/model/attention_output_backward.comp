#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Gradient of one side's attended values, and its scalar product with them (the softmax's gradient needs it, as in
// FlashAttention, Dao et al. 2022). A thread: 4 tokens, one head.
layout(local_size_x = 64) in;
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
void main() {
  uint n = sides(tokens[push.own], tokens[1u - push.own], push.capacity).x;
  uint quads = (n + 3u) / 4u;
  uint id = thread_index();
  if (id >= quads * HEADS) return;
  uint head = id / quads, first = 4u * (id % quads);
  vec4 g[4][8], product[4];
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = min(first + t, n - 1u) * TOKEN;
    [[unroll]] for (uint d = 0u; d < 8u; d++) g[t][d] = grad_updated[at + d];
    product[t] = vec4(0.0);
  }
  for (uint c = head * HEAD; c < head * HEAD + HEAD; c++) {
    vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
    [[unroll]] for (uint r = 0u; r < 32u; r++) {
      vec4 w = weights[push.to_out + r * INNER + c];
      [[unroll]] for (uint t = 0u; t < 4u; t++) sum[t] = fma(vec4(g[t][r / 4u][r % 4u]), w, sum[t]);
    }
    [[unroll]] for (uint t = 0u; t < 4u; t++) {
      uint at = min(first + t, n - 1u) * INNER + c;
      product[t] = fma(sum[t], mixed[at], product[t]);
      if (first + t < n) grad_mixed[at] = sum[t];
    }
  }
  [[unroll]] for (uint t = 0u; t < 4u; t++) {
    uint at = (first + t) * HEADS + head;
    if (first + t < n) rows[at] = vec3(softmax[at], sum4(product[t]));
  }
}
