#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Gradients of `activate`, of the Gaussians that touch a tile. The direction from which a color is seen is held: a Gaussian
// is not moved for the sake of its harmonics.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "harmonics.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };                      // [1] Gaussians that touch a tile
layout(binding = 1, scalar) readonly buffer List { uint list[]; };                        // [count] these
layout(binding = 2, scalar) readonly buffer Seen { vec3 seen[]; };                        // [N] of activate
layout(binding = 3, scalar) readonly buffer Scale { vec3 scale[]; };                      // [N] of activate
layout(binding = 4, scalar) readonly buffer Quaternion { vec4 quaternion[]; };            // [N] w x y z, of any length but 0
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };                 // [N] of activate
layout(binding = 6, scalar) readonly buffer Color { vec3 color[]; };                      // [N] of activate
layout(binding = 7, scalar) readonly buffer GradSeen { vec3 grad_seen[]; };               // [N] listed ones only, as all below
layout(binding = 8, scalar) readonly buffer GradScale { vec3 grad_scale[]; };             // [N]
layout(binding = 9, scalar) readonly buffer GradRotation { vec4 grad_rotation[]; };       // [N]
layout(binding = 10, scalar) readonly buffer GradOpacity { float grad_opacity[]; };       // [N]
layout(binding = 11, scalar) readonly buffer GradColor { vec3 grad_color[]; };            // [N]
layout(binding = 12, scalar) writeonly buffer GradPosition { vec3 grad_position[]; };     // [N]
layout(binding = 13, scalar) writeonly buffer GradLogScale { vec3 grad_log_scale[]; };    // [N]
layout(binding = 14, scalar) writeonly buffer GradQuaternion { vec4 grad_quaternion[]; }; // [N]
layout(binding = 15, scalar) writeonly buffer GradLogit { float grad_logit[]; };          // [N]
layout(binding = 16, scalar) writeonly buffer GradHarmonics { vec3 grad_harmonics[]; };   // [N*C]
layout(push_constant, scalar) uniform Push {
  uint coefficients; // C: 1, 4, 9 or 16
  float higher;      // a coefficient beyond the first is what is learnt times this
} push;
void main() {
  uint n = thread_index();
  if (n >= count[0]) return;
  uint i = list[n], first = i * push.coefficients;
  grad_position[i] = grad_seen[i];
  grad_log_scale[i] = grad_scale[i] * scale[i];
  vec4 q = quaternion[i], g = grad_rotation[i];
  float inverse = 1.0 / max(length(q), 1e-12);
  vec4 unit = q * inverse;
  grad_quaternion[i] = (g - unit * dot(unit, g)) * inverse;
  float o = opacity[i];
  grad_logit[i] = grad_opacity[i] * o * (1.0 - o);
  // Below 0 a color was cut off.
  vec3 above = vec3(greaterThan(color[i], vec3(0.0))) * grad_color[i], d = direction(seen[i]);
  grad_harmonics[first] = harmonic(0u, d) * above;
  above *= push.higher;
  for (uint k = 1u; k < push.coefficients; k++) grad_harmonics[first + k] = harmonic(k, d) * above;
}
