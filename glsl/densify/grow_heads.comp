#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Where a new cell begins among the sorted candidates.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Keys { uvec3 keys[]; };    // [candidate]
layout(binding = 1, scalar) readonly buffer Order { uint order[]; };   // [candidate] candidates sorted by cell
layout(binding = 2, scalar) writeonly buffer Flags { uint flags[]; };  // [candidate] 1: the first of its cell
layout(push_constant, scalar) uniform Push {
  uint found; // candidates
} push;
void main() {
  uint r = thread_index();
  if (r >= push.found) return;
  flags[r] = uint(r == 0u || keys[order[r]] != keys[order[r - 1u]]);
}
