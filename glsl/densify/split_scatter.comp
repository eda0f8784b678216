#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Rows put in their places.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Places { uint places[]; }; // [row] where it goes, each to another place
layout(binding = 1, scalar) readonly buffer From { uint from[]; };     // [row, width] words
layout(binding = 2, scalar) writeonly buffer To { uint to[]; };        // [.., width] words
layout(push_constant, scalar) uniform Push {
  uint rows;  // rows to put
  uint width; // words of a row
} push;
void main() {
  uint i = thread_index();
  if (i >= push.rows * push.width) return;
  uint row = i / push.width;
  to[places[row] * push.width + (i - row * push.width)] = from[i];
}
