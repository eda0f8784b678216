#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// The next 32 bits of the sort keys, in the order reached so far.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Keys { uvec3 keys[]; };    // [candidate]
layout(binding = 1, scalar) readonly buffer Order { uint order[]; };   // [candidate] candidates sorted by lower words
layout(binding = 2, scalar) writeonly buffer Words { uint words[]; };  // [candidate]
layout(push_constant, scalar) uniform Push {
  uint found; // candidates
  uint word;  // 1 or 2
} push;
void main() {
  uint r = thread_index();
  if (r >= push.found) return;
  uvec3 key = keys[order[r]];
  words[r] = push.word == 1u ? key.y : key.z;
}
