#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Opacity of every Gaussian that exists, less what the low-pass would add to its light: see `compensation.glsl`.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "compensation.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };           // [1] Gaussians that exist
layout(binding = 1, scalar) readonly buffer List { uint list[]; };             // [count] their slots
layout(binding = 2, scalar) readonly buffer Covariance { vec3 covariance[]; }; // [slot] of `project`, factored; 0 where nothing is seen of it
layout(binding = 3, scalar) readonly buffer Opacity { float opacity[]; };      // [slot] 0 to 1
layout(binding = 4, scalar) writeonly buffer Drawn { float drawn[]; };         // [slot] what is drawn of it; listed ones only
void main() {
  uint i = thread_index();
  if (i >= count[0]) return;
  uint slot = list[i];
  drawn[slot] = opacity[slot] * sqrt(kept_squared(covariance[slot]));
}
