#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Rows that stay, moved together.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Kept { uint kept[]; };    // [row] where it was
layout(binding = 1, scalar) readonly buffer From { uint from[]; };    // [.., width] words
layout(binding = 2, scalar) writeonly buffer To { uint to[]; };       // [row, width] words
layout(push_constant, scalar) uniform Push {
  uint rows;  // rows that stay
  uint width; // words of a row
} push;
void main() {
  uint i = thread_index();
  if (i >= push.rows * push.width) return;
  uint row = i / push.width;
  to[i] = from[kept[row] * push.width + (i - row * push.width)];
}
