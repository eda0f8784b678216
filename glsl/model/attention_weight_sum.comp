#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// Sum of the 8 slices of the weights' gradient, as a tree. No tokens: a gradient of zero.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer InsideQk { vec4 inside_qk[]; };           // [8 * 4096] slices
layout(binding = 2, scalar) readonly buffer AroundQk { vec4 around_qk[]; };           // [8 * 4096] slices
layout(binding = 3, scalar) readonly buffer InsideValue { vec4 inside_value[]; };     // [8 * 4096] slices
layout(binding = 4, scalar) readonly buffer AroundValue { vec4 around_value[]; };     // [8 * 4096] slices
layout(binding = 5, scalar) readonly buffer InsideOut { vec4 inside_out[]; };         // [8 * 4104] slices, a bias behind the matrix
layout(binding = 6, scalar) readonly buffer AroundOut { vec4 around_out[]; };         // [8 * 4104] slices, a bias behind the matrix
layout(binding = 7, scalar) writeonly buffer GradWeights { vec4 grad_weights[]; };    // [24592]
const uint MATRIX = 4096u, WITH_BIAS = 4104u;
#define TAKE(partial, size) [[unroll]] for (uint k = 0u; k < 8u; k++) s[k] = partial[k * size + i]
void main() {
  uint at = thread_index(), i = at;
  if (at >= 4u * MATRIX + 2u * WITH_BIAS) return;
  bool none = tokens[0] == 0u || tokens[1] == 0u;
  vec4 s[8];
  if (i < MATRIX) { TAKE(inside_qk, MATRIX); }
  else if ((i -= MATRIX) < MATRIX) { TAKE(around_qk, MATRIX); }
  else if ((i -= MATRIX) < MATRIX) { TAKE(inside_value, MATRIX); }
  else if ((i -= MATRIX) < MATRIX) { TAKE(around_value, MATRIX); }
  else if ((i -= MATRIX) < WITH_BIAS) { TAKE(inside_out, WITH_BIAS); }
  else { i -= WITH_BIAS; TAKE(around_out, WITH_BIAS); }
  [[unroll]] for (uint width = 4u; width > 0u; width /= 2u) {
    [[unroll]] for (uint k = 0u; k < width; k++) s[k] += s[k + width];
  }
  grad_weights[at] = none ? vec4(0.0) : s[0];
}
