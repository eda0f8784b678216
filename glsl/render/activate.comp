#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Static Gaussians from what is learnt to what the projection and the picture need: one thread per Gaussian.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "harmonics.glsl"
layout(binding = 0, scalar) readonly buffer Position { vec3 position[]; };     // [N] world
layout(binding = 1, scalar) readonly buffer LogScale { vec3 log_scale[]; };    // [N] logarithms of the standard deviations, world
layout(binding = 2, scalar) readonly buffer Quaternion { vec4 quaternion[]; }; // [N] w x y z, of any length but 0
layout(binding = 3, scalar) readonly buffer Logit { float logit[]; };          // [N] of the opacity
layout(binding = 4, scalar) readonly buffer Harmonics { vec3 harmonics[]; };   // [N*C] of the color less a half, as learnt
layout(binding = 5, scalar) writeonly buffer Seen { vec3 seen[]; };            // [N] seen from the camera's centre, world axes
layout(binding = 6, scalar) writeonly buffer Scale { vec3 scale[]; };          // [N] standard deviations, world
layout(binding = 7, scalar) writeonly buffer Rotation { vec4 rotation[]; };    // [N] unit quaternion w x y z
layout(binding = 8, scalar) writeonly buffer Opacity { float opacity[]; };     // [N] 0 to 1
layout(binding = 9, scalar) writeonly buffer Color { vec3 color[]; };          // [N] as displayed, 0 or more
layout(push_constant, scalar) uniform Push {
  vec3 center;       // camera centre, rounded
  vec3 center_low;   // what rounding took
  uint count;        // N
  uint coefficients; // C: 1, 4, 9 or 16
  float higher;      // a coefficient beyond the first is what is learnt times this
} push;
const float LARGEST_EXPONENT = 88.0; // e^88 is the last power of e below the largest float
void main() {
  uint i = thread_index();
  if (i >= push.count) return;
  precise vec3 p = (position[i] - push.center) - push.center_low;
  seen[i] = p;
  scale[i] = exp(min(log_scale[i], vec3(LARGEST_EXPONENT)));
  vec4 q = quaternion[i];
  rotation[i] = q / max(length(q), 1e-12);
  opacity[i] = 1.0 / (1.0 + exp(-logit[i]));
  vec3 d = direction(p), sum = vec3(0.0);
  for (uint k = 1u; k < push.coefficients; k++) sum += harmonic(k, d) * harmonics[i * push.coefficients + k];
  sum = vec3(0.5) + harmonic(0u, d) * harmonics[i * push.coefficients] + push.higher * sum;
  color[i] = max(sum, vec3(0.0));
}
