#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Gradients of `compensate`, of the Gaussians that touch a tile: of what is drawn to the opacity, in its place, and to the
// factors of the covariance, added.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "compensation.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };           // [1] Gaussians that touch a tile
layout(binding = 1, scalar) readonly buffer List { uint list[]; };             // [count] their slots
layout(binding = 2, scalar) readonly buffer Covariance { vec3 covariance[]; }; // [slot] of `project`, factored
layout(binding = 3, scalar) readonly buffer Opacity { float opacity[]; };      // [slot] of `compensate`
layout(binding = 4, scalar) buffer GradOpacity { float grad_opacity[]; };      // [slot] of what is drawn, and then of the opacity; listed ones only
layout(binding = 5, scalar) buffer GradCovariance { vec3 grad_covariance[]; }; // [slot] of the factors: variance of x given y, slope, variance of y; likewise
void main() {
  uint i = thread_index();
  if (i >= count[0]) return;
  uint slot = list[i];
  vec3 of = covariance[slot];
  float n = DILATION / of.x, v = DILATION / of.z, kept = sqrt(kept_squared(of));
  float of_square = 0.5 * grad_opacity[slot] * opacity[slot] / kept;
  grad_covariance[slot] += of_square *
    vec3(n / of.x * ((1.0 - v) + of.y * of.y), -2.0 * n * of.y, v / of.z * (1.0 - n));
  grad_opacity[slot] *= kept;
}
