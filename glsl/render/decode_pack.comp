#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The decoder's weights in rows of vec4, padded with zeros: once per step.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Weights { float weights[]; };  // [W] the model's
layout(binding = 1, scalar) writeonly buffer Packed { vec4 packed[]; };    // [96*10 + D*8 + D/4] first layer with its biases, second layer, its biases
float first(uint row, uint column) {
  uint from = head_weights(row / HIDDEN, OFFSETS), unit = row % HIDDEN;
  if (column > INPUT) return 0.0;
  return weights[from + (column < INPUT ? unit * INPUT + column : HIDDEN * INPUT + unit)];
}
float second(uint row, uint column) { // column HIDDEN is the bias
  uint head = row < head_row(1u, OFFSETS) ? 0u : row < head_row(2u, OFFSETS) ? 1u : 2u;
  uint outputs = per_gaussian(head) * OFFSETS, from = head_weights(head, OFFSETS) + FIRST_WEIGHTS;
  row -= head_row(head, OFFSETS);
  if (row >= outputs) return 0.0;
  return weights[from + (column < HIDDEN ? row * HIDDEN + column : outputs * HIDDEN + row)];
}
void main() {
  uint i = thread_index();
  uint rows = head_row(3u, OFFSETS), biases = FIRST_VEC4 + rows * ROW_VEC4;
  if (i >= biases + rows / 4u) return;
  vec4 v;
  for (uint c = 0u; c < 4u; ++c) {
    if (i < FIRST_VEC4) v[c] = first(i / INPUT_VEC4, 4u * (i % INPUT_VEC4) + c);
    else if (i < biases) v[c] = second((i - FIRST_VEC4) / ROW_VEC4, 4u * ((i - FIRST_VEC4) % ROW_VEC4) + c);
    else v[c] = second(4u * (i - biases) + c, HIDDEN);
  }
  packed[i] = v;
}
