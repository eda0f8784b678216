#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the first layer to the features. A workgroup: 32 anchors.
layout(local_size_x = 64) in;
#define ROWS 32u
#define COLUMNS 32u
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "product.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };           // [V] anchors
layout(binding = 2, scalar) readonly buffer Packed { vec4 packed[]; };             // of decode_pack
layout(binding = 3, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; };    // [V*24] of decode_backward_hidden
layout(binding = 4, scalar) writeonly buffer GradFeature { vec4 grad_feature[]; }; // [N*8] visible anchors only
uint first, last;
void put(uint run) {
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, grad_hidden[min(first + i / 2u, last) * HIDDEN_VEC4 + 2u * run + i % 2u]);
  EACH(i, RUN * ACROSS) put_right_across(i / ACROSS, i % ACROSS, packed[(RUN * run + i / ACROSS) * INPUT_VEC4 + i % ACROSS]);
}
void main() {
  uint n = groups[3];
  first = ROWS * group_index();
  if (first >= n) return;
  last = n - 1u;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(HIDDEN_VEC4 / 2u, sum);
  uint v = first + 4u * block_row();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    if (v + r < n) grad_feature[visible[v + r] * ACROSS + block_column()] = sum[r];
  }
}
