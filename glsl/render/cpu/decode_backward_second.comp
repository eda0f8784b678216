#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// One head's second layer's weight and bias gradients, summed over each chunk of listed Gaussians of the same k. A thread
// computes the Gaussian's outputs by UNITS units.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint HEAD = 2u;     // 0 opacity, 1 color, 2 cov
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Segments { uint segments[]; };  // [K+2] of decode_lists
layout(binding = 1, scalar) readonly buffer Listed { uint listed[]; };           // [list] slots k V + v, ascending
layout(binding = 2, scalar) readonly buffer Hidden { vec4 hidden[]; };           // [V*24] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { float grad_output[]; }; // [V*D] of decode_backward
layout(binding = 4, scalar) writeonly buffer Partial { vec4 partial[]; };        // [chunk*91] 11 outputs by 32 units, 11 biases
void main() {
  const uint PARTS = HIDDEN / UNITS, OUTPUTS = (2u << HEAD) - 1u, BEFORE = (2u << HEAD) - 2u - HEAD;
  uint t = thread_index(), n = segments[OFFSETS + 1u], chunk = t / PARTS, column = UNITS_VEC4 * (t % PARTS);
  uint run = chunk_listed(segments[OFFSETS]);
  RUN_OF(chunk, run, k, begin, end)
  if (begin == end) return;
  vec4 sum[OUTPUTS * UNITS_VEC4];
  float bias[OUTPUTS];
  [[unroll]] for (uint i = 0u; i < OUTPUTS * UNITS_VEC4; ++i) sum[i] = vec4(0.0);
  [[unroll]] for (uint i = 0u; i < OUTPUTS; ++i) bias[i] = 0.0;
  uint rows = head_row(3u, OFFSETS), row = head_row(HEAD, OFFSETS) + OUTPUTS * k;
  for (uint i = begin; i < end; ++i) {
    uint v = listed[i] - k * n, h = v * HIDDEN_VEC4 + HEAD * ROW_VEC4 + column, from = v * rows + row;
    vec4 x[UNITS_VEC4];
    [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) x[q] = hidden[h + q];
    [[unroll]] for (uint o = 0u; o < OUTPUTS; ++o) {
      float g = grad_output[from + o];
      bias[o] += g;
      [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) sum[UNITS_VEC4 * o + q] = add_scaled(sum[UNITS_VEC4 * o + q], g, x[q]);
    }
  }
  uint to = chunk * SECOND_VEC4;
  [[unroll]] for (uint o = 0u; o < OUTPUTS; ++o) {
    uint at = BEFORE + o;
    [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) partial[to + at * ROW_VEC4 + column + q] = sum[UNITS_VEC4 * o + q];
    if (column == 0u) partial[to + 11u * ROW_VEC4 + at / 4u][at % 4u] = bias[o];
  }
}
