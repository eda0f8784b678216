#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the second layer and the ReLU. A workgroup: 32 anchors, the units of one head.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#define ROWS 32u
#define COLUMNS 32u
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "product.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };            // of decode_pack
layout(binding = 2, scalar) readonly buffer Positive { uint positive[]; };        // [V*6] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { vec4 grad_output[]; };   // [V*D/4] of decode_backward
layout(binding = 4, scalar) writeonly buffer GradHidden { vec4 grad_hidden[]; };  // [V*24] before the ReLU
uint first, last, head;
void put(uint run) {
  uint row = head_row(head, OFFSETS) + RUN * run, stride = head_row(HEADS, OFFSETS) / 4u;
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, grad_output[min(first + i / 2u, last) * stride + row / 4u + i % 2u]);
  EACH(i, RUN * ROW_VEC4) put_right_across(i / ROW_VEC4, i % ROW_VEC4, packed[FIRST_VEC4 + row * ROW_VEC4 + i]);
}
void main() {
  uint n = groups[3], blocks = (n + ROWS - 1u) / ROWS, id = group_index();
  if (id >= blocks * HEADS) return;
  head = id % HEADS;
  first = ROWS * (id / HEADS);
  last = n - 1u;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product((head_row(head + 1u, OFFSETS) - head_row(head, OFFSETS)) / RUN, sum);
  uint v = first + 4u * block_row(), unit4 = head * ROW_VEC4 + block_column();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    if (v + r < n) {
      uint bits = positive[(v + r) * POSITIVE + unit4 / UNITS_VEC4];
      grad_hidden[(v + r) * HIDDEN_VEC4 + unit4] = mix(vec4(0.0), sum[r], positive_at(bits, unit4 % UNITS_VEC4));
    }
  }
}
