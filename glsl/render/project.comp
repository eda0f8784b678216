#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// EWA splatting through a distorting lens: mean, covariance and depth on the picture of every Gaussian that exists.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "camera.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };              // [1] Gaussians that exist
layout(binding = 1, scalar) readonly buffer List { uint list[]; };                // [count] their slots
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };        // [slot] seen from the camera's centre, world axes
layout(binding = 3, scalar) readonly buffer Scale { vec3 scale[]; };              // [slot] standard deviations, world
layout(binding = 4, scalar) readonly buffer Rotation { vec4 rotation[]; };        // [slot] unit quaternion w x y z
layout(binding = 5, scalar) writeonly buffer Mean { vec2 mean[]; };               // [slot] px; listed ones only
layout(binding = 6, scalar) writeonly buffer Covariance { vec3 covariance[]; };   // [slot] factored: variance of x given y, px^2; slope of x on y; variance of y, px^2; likewise
layout(binding = 7, scalar) writeonly buffer Depth { float depth[]; };            // [slot] camera z; 0 where nothing is seen of it; likewise
layout(push_constant, scalar) uniform Push {
  vec3 rotation0;    // first row of R, world to camera
  vec3 rotation1;    // second row
  vec3 rotation2;    // third row
  vec4 lens;         // fx fy cx cy, px
  vec4 distortion;   // k1 k2 p1 p2
  vec4 limits;       // lowest x y, highest x y at which the Jacobian is taken, normalised coordinates
  float near;        // a Gaussian's depth is larger
  float max_radius2; // its squared normalised radius is at most this: there the lens polynomial folds back
} push;
void main() {
  uint i = thread_index();
  if (i >= count[0]) return;
  uint slot = list[i];
  Camera camera = CAMERA(push);
  vec2 m = vec2(0.0);
  vec3 v = vec3(0.0);
  float z = 0.0;
  vec3 p = to_camera(camera, position[slot]);
  if (in_front(camera, p)) {
    z = p.z;
    float inverse_z = 1.0 / z;
    vec2 xy = p.xy * inverse_z;
    m = distort(camera.distortion, xy) * camera.lens.xy + camera.lens.zw;
    vec2 at = clamp_to_limits(camera, xy, beyond(camera, p));
    vec3 row0, row1;
    perspective(camera, at, distort_jacobian(camera.distortion, at), row0, row1);
    mat3 q = rotation_matrix(rotation[slot]);
    vec3 s = scale[slot];
    Axes axes = axes_of(to_world(camera, row0 * inverse_z), to_world(camera, row1 * inverse_z), q, s);
    v = vec3(narrow_variance(axes, s), axes.slope, axes.variance);
    // Overflow and not-a-number, from the inputs or from z close to zero: no Gaussian.
    if (!representable(m, axes, v.x, z)) {
      m = vec2(0.0);
      v = vec3(0.0);
      z = 0.0;
    }
  }
  mean[slot] = m;
  covariance[slot] = v;
  depth[slot] = z;
}
