#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// As decode_backward_second, of all heads, for GPUs: a thread computes 4 units of one of the Gaussian's 11 outputs.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Segments { uint segments[]; };  // [K+2] of decode_lists
layout(binding = 1, scalar) readonly buffer Listed { uint listed[]; };           // [list] slots k V + v, ascending
layout(binding = 2, scalar) readonly buffer Hidden { vec4 hidden[]; };           // [V*24] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { float grad_output[]; }; // [V*D] of decode_backward
layout(binding = 4, scalar) writeonly buffer Partial { vec4 partial[]; };        // [chunk*91] 11 outputs by 32 units, 11 biases
void main() {
  uint t = thread_index(), n = segments[OFFSETS + 1u], chunk = t / SECOND_THREADS, at = t % SECOND_THREADS;
  uint run = chunk_listed(segments[OFFSETS]);
  RUN_OF(chunk, run, k, begin, end)
  if (begin == end) return;
  uint output_ = at / ROW_VEC4, quad = at % ROW_VEC4, head = output_ < 1u ? 0u : output_ < 4u ? 1u : 2u;
  uint rows = head_row(HEADS, OFFSETS);
  uint row = head_row(head, OFFSETS) + per_gaussian(head) * k + output_ - per_gaussian_before(head);
  vec4 sum = vec4(0.0);
  float bias = 0.0;
  for (uint i = begin; i < end; ++i) {
    uint v = listed[i] - k * n;
    float g = grad_output[v * rows + row];
    bias += g;
    sum = add_scaled(sum, g, hidden[v * HIDDEN_VEC4 + head * ROW_VEC4 + quad]);
  }
  uint to = chunk * SECOND_VEC4;
  partial[to + at] = sum;
  if (quad == 0u) partial[to + 11u * ROW_VEC4 + output_ / 4u][output_ % 4u] = bias;
}
