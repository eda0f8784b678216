#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// variant color: COLOR_ONLY
//
// Gradients of `project`, of the Gaussians that touch a tile; `color` for losses that do not look at depth. A coordinate at which the Jacobian's point was clamped has no gradient through the covariance.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "camera.glsl"
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };                        // [1] Gaussians that touch a tile
layout(binding = 1, scalar) readonly buffer List { uint list[]; };                          // [count] their slots
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };                  // [slot] seen from the camera's centre, world axes
layout(binding = 3, scalar) readonly buffer Scale { vec3 scale[]; };                        // [slot] standard deviations, world
layout(binding = 4, scalar) readonly buffer Rotation { vec4 rotation[]; };                  // [slot] unit quaternion w x y z
layout(binding = 5, scalar) readonly buffer GradMean { vec2 grad_mean[]; };                 // [slot] per px
layout(binding = 6, scalar) readonly buffer GradCovariance { vec3 grad_covariance[]; };     // [slot] of the factors: variance of x given y, slope, variance of y
layout(binding = 7, scalar) writeonly buffer GradPosition { vec3 grad_position[]; };        // [slot] listed ones only
layout(binding = 8, scalar) writeonly buffer GradScale { vec3 grad_scale[]; };              // [slot] likewise
layout(binding = 9, scalar) writeonly buffer GradRotation { vec4 grad_rotation[]; };       // [slot] of the quaternion as given, likewise
#ifndef COLOR_ONLY
layout(binding = 10, scalar) readonly buffer GradDepth { float grad_depth[]; };              // [slot]
#endif
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
  vec3 p = to_camera(camera, position[slot]);
  float inverse_z = 1.0 / p.z;
  vec2 xy = p.xy * inverse_z;
  ivec2 side = beyond(camera, p);
  vec2 at = clamp_to_limits(camera, xy, side);
  vec3 d = distort_jacobian(camera.distortion, at);
  vec3 row0, row1;
  perspective(camera, at, d, row0, row1);
  row0 *= inverse_z;
  row1 *= inverse_z;
  vec3 t0 = to_world(camera, row0), t1 = to_world(camera, row1), s = scale[slot];
  vec4 quaternion = rotation[slot];
  mat3 q = rotation_matrix(quaternion);
  Axes axes = axes_of(t0, t1, q, s);

  // With the residual r = s h = u0 - k u1: dN = 2 r (du0 - k du1) (N is the least over all slopes), V dk = u1 du0 +
  // (r - k u1) du1. Of the scale's gradient m0 gu0 + m1 gu1 the large terms cancel on paper, not in float32.
  vec3 g = grad_covariance[slot];
  float g_slope = g.y / axes.variance;
  vec3 h = residual(axes, s), r = s * h;
  vec3 along = g_slope * r + 2.0 * g.z * axes.u1;
  vec3 gu0 = 2.0 * g.x * r + g_slope * axes.u1, gu1 = along - axes.slope * gu0;
  vec3 gs = 2.0 * (g.x * r * h + axes.m1 * (g_slope * r + g.z * axes.u1));
  grad_scale[slot] = gs;
  // Column k of Q: its gradient is s_k (t0 gu0_k + t1 gu1_k).
  vec3 a = gu0 * s, b = gu1 * s;
  vec3 c0 = t0 * a.x + t1 * b.x, c1 = t0 * a.y + t1 * b.y, c2 = t0 * a.z + t1 * b.z;
  float w = quaternion.x, x = quaternion.y, y = quaternion.z, z = quaternion.w;
  grad_rotation[slot] = 2.0 * vec4(
    x * (c1.z - c2.y) + y * (c2.x - c0.z) + z * (c0.y - c1.x),
    w * (c1.z - c2.y) + y * (c0.y + c1.x) + z * (c0.z + c2.x) - 2.0 * x * (c1.y + c2.z),
    w * (c2.x - c0.z) + x * (c0.y + c1.x) + z * (c1.z + c2.y) - 2.0 * y * (c0.x + c2.z),
    w * (c0.y - c1.x) + x * (c0.z + c2.x) + y * (c1.z + c2.y) - 2.0 * z * (c0.x + c1.y));

  // To the rows of the Jacobian, in camera coordinates.
  vec3 j0 = rotate(camera, q * a), j1 = rotate(camera, q * b);
  vec3 e0 = j0 * (camera.lens.x * inverse_z), e1 = j1 * (camera.lens.y * inverse_z);
  vec3 gd = vec3(e0.x - e0.z * at.x, (e0.y - e0.z * at.y) + (e1.x - e1.z * at.x), e1.y - e1.z * at.y);
  vec2 g_at = -vec2(e0.z * d.x + e1.z * d.y, e0.z * d.y + e1.z * d.z) + distort_jacobian_backward(camera.distortion, at, gd);
  // All rows of J are in proportion to 1/z, as is the Gaussian's size.
  float gz = -dot(gs, s) * inverse_z;
#ifndef COLOR_ONLY
  gz += grad_depth[slot];
#endif

  vec3 m = distort_jacobian(camera.distortion, xy);
  vec2 gm = grad_mean[slot] * camera.lens.xy;
  vec2 g_xy = vec2(m.x * gm.x + m.y * gm.y, m.y * gm.x + m.z * gm.y) + vec2(equal(side, ivec2(0))) * g_at;
  vec3 gp = vec3(g_xy * inverse_z, gz - dot(g_xy, xy) * inverse_z);
  grad_position[slot] = to_world(camera, gp);
}
