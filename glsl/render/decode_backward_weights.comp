#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Sums the chunks' weight gradients in a fixed order: runs of 32 chunks, then the runs.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer First { vec4 first[]; };                // of decode_backward_first
layout(binding = 2, scalar) readonly buffer Second { vec4 second[]; };              // of decode_backward_second
layout(binding = 3, scalar) writeonly buffer GradWeights { float grad_weights[]; }; // [W] every one is written
void main() {
  uint w = thread_index();
  if (w >= head_weights(3u, OFFSETS)) return;
  uint head = w < head_weights(1u, OFFSETS) ? 0u : w < head_weights(2u, OFFSETS) ? 1u : 2u;
  uint at = w - head_weights(head, OFFSETS), rows = head_row(3u, OFFSETS), outputs = per_gaussian(head) * OFFSETS;
  bool in_first = at < FIRST_WEIGHTS;
  uint element, stride;
  if (in_first) {
    bool matrix = at < HIDDEN * INPUT;
    uint unit = matrix ? at / INPUT : at - HIDDEN * INPUT, column = matrix ? at % INPUT : INPUT;
    element = (head * HIDDEN + unit) * 4u * INPUT_VEC4 + column;
    stride = FIRST_VEC4;
  } else {
    at -= FIRST_WEIGHTS;
    bool matrix = at < outputs * HIDDEN;
    uint row = head_row(head, OFFSETS) + (matrix ? at / HIDDEN : at - outputs * HIDDEN);
    element = matrix ? row * HIDDEN + at % HIDDEN : rows * HIDDEN + row;
    stride = rows * ROW_VEC4 + rows / 4u;
  }
  uint n = groups[3], chunk = chunk_anchors(n), chunks = (n + chunk - 1u) / chunk;
  uint at4 = element / 4u, component = element % 4u;
  float total = 0.0;
  for (uint begin = 0u; begin < chunks; begin += 32u) {
    float run = 0.0;
    for (uint c = begin; c < min(begin + 32u, chunks); ++c) {
      if (in_first) run += first[c * stride + at4][component];
      else run += second[c * stride + at4][component];
    }
    total += run;
  }
  grad_weights[w] = total;
}
