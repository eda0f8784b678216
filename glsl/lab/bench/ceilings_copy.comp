#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// variant vec4: VEC4
// An array to another, ITEMS elements per thread, a group apart so that neighbours stay neighbours: what memory gives a
// kernel that does nothing else.
layout(local_size_x = 64) in;
#ifdef VEC4
#define ELEMENT vec4
layout(binding = 0, scalar) readonly buffer From { vec4 from[]; };  // [n]
layout(binding = 1, scalar) writeonly buffer To { vec4 to[]; };     // [n]
#else
#define ELEMENT float
layout(binding = 0, scalar) readonly buffer From { float from[]; }; // [n]
layout(binding = 1, scalar) writeonly buffer To { float to[]; };    // [n]
#endif
layout(push_constant, scalar) uniform Push {
  uint n; // elements
} push;
const uint ITEMS = 4u;
void main() {
  uint i = group_index() * (gl_WorkGroupSize.x * ITEMS) + gl_LocalInvocationID.x;
  for (uint k = 0u; k < ITEMS && i < push.n; k++, i += gl_WorkGroupSize.x) to[i] = from[i];
}
