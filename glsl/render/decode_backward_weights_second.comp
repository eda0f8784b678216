#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Sums the chunks' gradients of the second layer's weights in a fixed order: for each k runs of 32 chunks, then the runs.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint LANES = 16u;   // threads that share a vec4's runs, as of decode_backward_weights
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Segments { uint segments[]; };          // [K+2] of decode_lists
layout(binding = 1, scalar) readonly buffer Partial { vec4 partial[]; };            // of decode_backward_second
layout(binding = 2, scalar) writeonly buffer GradWeights { float grad_weights[]; }; // [W] every one of the second layer is written
#include "chunk_sum.glsl"
void main() {
  // Threads that share a sum need workgroups of one k: they have as many runs to wait for.
  const uint GROUPS = (SECOND_VEC4 + SUM_WIDTH - 1u) / SUM_WIDTH;
  uint at = group_index() * SUM_WIDTH + sum_column(), each = LANES == 1u ? SECOND_VEC4 : GROUPS * SUM_WIDTH;
  uint k = at / each, i = at % each;
  if (k >= OFFSETS) return;
  uint first = 0u, chunks = 0u, chunk = chunk_listed(segments[OFFSETS]);
  for (uint j = 0u; j <= k; ++j) {
    first += chunks;
    chunks = (segments[j + 1u] - segments[j] + chunk - 1u) / chunk;
  }
  vec4 total = chunk_sum(first, chunks, SECOND_VEC4, min(i, SECOND_VEC4 - 1u));
  if (i >= SECOND_VEC4 || sum_lane() != 0u) return;
  for (uint c = 0u; c < 4u; ++c) {
    bool matrix = i < 11u * ROW_VEC4;
    uint output_ = matrix ? i / ROW_VEC4 : 4u * (i - 11u * ROW_VEC4) + c;
    if (output_ >= 11u) return;
    uint head = output_ < 1u ? 0u : output_ < 4u ? 1u : 2u, outputs = per_gaussian(head) * OFFSETS;
    uint row = per_gaussian(head) * k + output_ - per_gaussian_before(head);
    uint from = head_weights(head, OFFSETS) + FIRST_WEIGHTS;
    grad_weights[from + (matrix ? row * HIDDEN + 4u * (i % ROW_VEC4) + c : outputs * HIDDEN + row)] = total[c];
  }
}
