#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// First layer's weight gradients, summed over each chunk of visible anchors. A workgroup: a chunk.
layout(local_size_x = 240) in;
#define ROWS 96u
#define COLUMNS 40u
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "product.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Inputs { vec4 inputs[]; };          // [V*10] of decode_input
layout(binding = 2, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; }; // [V*24] of decode_backward_hidden
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [chunk*96*10] like the packed first layer
uint begin, end;
void put(uint run) {
  uint v = begin + RUN * run;
  EACH(i, RUN * HIDDEN_VEC4)
    put_left_across(i / HIDDEN_VEC4, i % HIDDEN_VEC4, v + i / HIDDEN_VEC4 < end ? grad_hidden[v * HIDDEN_VEC4 + i] : vec4(0.0));
  EACH(i, RUN * INPUT_VEC4)
    put_right_across(i / INPUT_VEC4, i % INPUT_VEC4, v + i / INPUT_VEC4 < end ? inputs[v * INPUT_VEC4 + i] : vec4(0.0));
}
void main() {
  uint part = group_index(), n = groups[3], chunk = chunk_anchors(n);
  begin = part * chunk;
  if (begin >= n) return;
  end = min(n, begin + chunk);
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product((end - begin + RUN - 1u) / RUN, sum);
  uint to = part * FIRST_VEC4 + 4u * block_row() * INPUT_VEC4 + block_column();
  [[unroll]] for (uint r = 0u; r < 4u; ++r) partial[to + r * INPUT_VEC4] = sum[r];
}
