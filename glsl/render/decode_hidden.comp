#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Hidden units of the three heads, ReLU(W x + b). A workgroup: 32 anchors, all units.
layout(local_size_x = 192) in;
#define ROWS 32u
#define COLUMNS 96u
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "product.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };    // of decode_pack
layout(binding = 2, scalar) readonly buffer Inputs { vec4 inputs[]; };    // [V*10] of decode_input
layout(binding = 3, scalar) writeonly buffer Hidden { vec4 hidden[]; };   // [V*24] opacity 32, color 32, cov 32
layout(binding = 4, scalar) writeonly buffer Positive { uint positive[]; }; // [V*6] 16 bits each: which of the units are positive
shared uint signs[SLICE_THREADS]; // a bit for each of a thread's 4 x 4
uint first, last;
void put(uint run) {
  EACH(i, 2u * ROWS) put_left(i / 2u, i % 2u, inputs[min(first + i / 2u, last) * INPUT_VEC4 + 2u * run + i % 2u]);
  EACH(i, 2u * COLUMNS) put_right(i / 2u, i % 2u, packed[i / 2u * INPUT_VEC4 + 2u * run + i % 2u]);
}
void main() {
  uint n = groups[3];
  first = ROWS * group_index();
  if (first >= n) return;
  last = n - 1u;
  vec4 sum[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
  add_product(INPUT_VEC4 / 2u, sum);
  uint v = first + 4u * block_row(), bits = 0u;
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    vec4 h = max(sum[r], 0.0);
    bits |= positive_bits(h, r);
    if (v + r < n) hidden[(v + r) * HIDDEN_VEC4 + block_column()] = h;
  }
  signs[gl_LocalInvocationID.x] = bits;
  barrier();
  // A word of 16 units is made of what four threads have of its anchor.
  uint row = gl_LocalInvocationID.x / POSITIVE, word = gl_LocalInvocationID.x % POSITIVE, all = 0u;
  [[unroll]] for (uint q = 0u; q < 4u; ++q)
    all |= (signs[row / 4u * ACROSS + 4u * word + q] >> 4u * (row % 4u) & 15u) << 4u * q;
  if (first + row < n) positive[(first + row) * POSITIVE + word] = all;
}
