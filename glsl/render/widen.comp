#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Adds to the variance of every Gaussian what the pixels that it was trained with are larger than those it is drawn with.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };         // [1] Gaussians that exist
layout(binding = 1, scalar) readonly buffer List { uint list[]; };           // [count] their slots
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };   // [slot] seen from the camera's centre, world axes
layout(binding = 3, scalar) buffer Scale { vec3 scale[]; };                  // [slot] standard deviations, world; listed ones only
layout(push_constant, scalar) uniform Push {
  vec3 ahead;  // third row of R: the view axis
  float added; // variance at depth 1
} push;
void main() {
  uint i = thread_index();
  if (i >= count[0]) return;
  uint slot = list[i];
  float z = dot(push.ahead, position[slot]);
  vec3 s = scale[slot];
  scale[slot] = sqrt(s * s + vec3(push.added * (z * z)));
}
