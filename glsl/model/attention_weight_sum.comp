#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// Sum of the 8 slices of the weights' gradient, as a tree. No tokens: a gradient of zero.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Partial { vec4 partial[]; };              // [8 * 24592] slices of all weights' gradient
layout(binding = 2, scalar) writeonly buffer GradWeights { vec4 grad_weights[]; };    // [24592]
const uint ALL = 24592u;
void main() {
  uint i = thread_index();
  if (i >= ALL) return;
  bool none = tokens[0] == 0u || tokens[1] == 0u;
  vec4 s[8];
  [[unroll]] for (uint k = 0u; k < 8u; k++) s[k] = partial[k * ALL + i];
  [[unroll]] for (uint width = 4u; width > 0u; width /= 2u) {
    [[unroll]] for (uint k = 0u; k < width; k++) s[k] += s[k + width];
  }
  grad_weights[i] = none ? vec4(0.0) : s[0];
}
