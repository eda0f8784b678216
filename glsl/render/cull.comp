#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Anchors whose own ellipsoid touches the view (Scaffold-GS): three standard deviations of its longer axis on the picture.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "camera.glsl"
layout(binding = 0, scalar) readonly buffer Position { vec3 position[]; };        // [N] world
layout(binding = 1, scalar) readonly buffer LogScaling { float log_scaling[]; };  // [N*6] the first three are the ellipsoid's
layout(binding = 2, scalar) writeonly buffer Flags { uint flags[]; };             // [N] 1 for an anchor to decode, otherwise 0
layout(push_constant, scalar) uniform Push {
  vec3 rotation0;    // first row of R, world to camera
  vec3 rotation1;    // second row
  vec3 rotation2;    // third row
  vec3 center;       // of the camera, world, rounded
  vec3 center_low;   // the rest of it
  vec4 lens;         // fx fy cx cy, px
  vec4 distortion;   // k1 k2 p1 p2
  vec4 limits;       // lowest x y, highest x y at which the Jacobian is taken, normalised coordinates
  float near;        // an anchor's depth is larger
  float max_radius2; // its squared normalised radius is at most this: there the lens polynomial folds back
  uvec2 size;        // picture, px
  uint anchors;      // N
} push;
void main() {
  uint anchor = thread_index();
  if (anchor >= push.anchors) return;
  Camera camera = CAMERA(push);
  vec3 p = to_camera(camera, from_center(position[anchor], push.center, push.center_low));
  bool touches = in_front(camera, p);
  if (touches) {
    float inverse_z = 1.0 / p.z;
    vec2 xy = p.xy * inverse_z;
    vec2 mean = distort(camera.distortion, xy) * camera.lens.xy + camera.lens.zw;
    vec2 at = clamp_to_limits(camera, xy, beyond(camera, p));
    vec3 row0, row1;
    perspective(camera, at, distort_jacobian(camera.distortion, at), row0, row1);
    uint l = 6u * anchor;
    vec3 s = exp(vec3(log_scaling[l], log_scaling[l + 1u], log_scaling[l + 2u]));
    vec3 u0 = to_world(camera, row0 * inverse_z) * s, u1 = to_world(camera, row1 * inverse_z) * s;
    float radius = three_sigma(vec3(dot(u0, u0) + DILATION, dot(u0, u1), dot(u1, u1) + DILATION));
    // Written so that a radius that overflowed, or is not a number, keeps the anchor.
    vec2 size = vec2(push.size);
    touches = !(any(lessThan(mean + radius, vec2(0.0))) || any(greaterThan(mean - radius, size)));
  }
  flags[anchor] = touches ? 1u : 0u;
}
