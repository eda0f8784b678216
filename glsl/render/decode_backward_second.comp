#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The second layer's weight and bias gradients, summed over each chunk of listed Gaussians of the same k. A thread computes
// the Gaussian's 11 outputs by a part of their heads' units.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint PARTS = 4u;    // parts of a head's units
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Segments { uint segments[]; };  // [K+2] of decode_lists
layout(binding = 1, scalar) readonly buffer Listed { uint listed[]; };           // [list] slots k V + v, ascending
layout(binding = 2, scalar) readonly buffer Hidden { vec4 hidden[]; };           // [V*24] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { float grad_output[]; }; // [V*D] of decode_backward
layout(binding = 4, scalar) writeonly buffer Partial { vec4 partial[]; };        // [chunk*91] 11 outputs by 32 units, 11 biases
void main() {
  const uint COLUMNS = ROW_VEC4 / PARTS;
  uint t = thread_index(), n = segments[OFFSETS + 1u], chunk = t / PARTS, column = COLUMNS * (t % PARTS);
  uint run = chunk_listed(segments[OFFSETS]);
  RUN_OF(chunk, run, k, begin, end)
  if (begin == end) return;
  vec4 sum[11u * COLUMNS];
  float bias[11];
  [[unroll]] for (uint i = 0u; i < 11u * COLUMNS; ++i) sum[i] = vec4(0.0);
  [[unroll]] for (uint i = 0u; i < 11u; ++i) bias[i] = 0.0;
  uint rows = head_row(3u, OFFSETS);
  for (uint i = begin; i < end; ++i) {
    uint v = listed[i] - k * n, from = v * rows;
    [[unroll]] for (uint head = 0u; head < HEADS; ++head) {
      uint outputs = per_gaussian(head), h = v * HIDDEN_VEC4 + head * ROW_VEC4 + column;
      vec4 x[COLUMNS];
      [[unroll]] for (uint q = 0u; q < COLUMNS; ++q) x[q] = hidden[h + q];
      [[unroll]] for (uint o = 0u; o < outputs; ++o) {
        uint at = per_gaussian_before(head) + o;
        float g = grad_output[from + head_row(head, OFFSETS) + outputs * k + o];
        bias[at] += g;
        [[unroll]] for (uint q = 0u; q < COLUMNS; ++q) sum[COLUMNS * at + q] = add_scaled(sum[COLUMNS * at + q], g, x[q]);
      }
    }
  }
  uint to = chunk * SECOND_VEC4;
  [[unroll]] for (uint at = 0u; at < 11u; ++at) {
    [[unroll]] for (uint q = 0u; q < COLUMNS; ++q) partial[to + at * ROW_VEC4 + column + q] = sum[COLUMNS * at + q];
    if (column == 0u) partial[to + 11u * ROW_VEC4 + at / 4u][at % 4u] = bias[at];
  }
}
