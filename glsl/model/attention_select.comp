#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "patch.glsl"
#include "camera.glsl"
// Sort keys of the visible anchors: those whose centre falls into the patch come first, inside the mask before around
// it, each in an order of its own random numbers. A thread: one visible anchor.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer VisibleCount { uint visible_count[]; }; // [1]
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };            // [V] anchors
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };          // [N] scene units
layout(binding = 3, scalar) readonly buffer Picture { uint picture[]; };            // [pixel] mask in the highest byte: inside from 128 on
layout(binding = 4, scalar) writeonly buffer Keys { uint keys[]; };                 // [V] side (2 bits: inside, around, neither), random (30)
layout(binding = 5, scalar) writeonly buffer Anchors { uint anchors[]; };           // [V] anchor of the key
layout(binding = 6, scalar) buffer Candidates { uint candidates[]; };               // [2] inside, around; zero before
layout(push_constant, scalar) uniform Push {
  vec3 rotation0;    // first row of the rotation, world to camera
  vec3 rotation1;    // second row
  vec3 rotation2;    // third row
  vec3 center;       // of the camera, scene units, rounded
  vec3 center_low;   // the rest of it
  vec4 lens;         // fx fy cx cy, px
  vec4 distortion;   // k1 k2 p1 p2
  float near;        // smallest depth, scene units
  float max_radius2; // squared radius at which the lens polynomial folds back
  uvec2 corner;      // lowest pixel of the patch
  uvec2 side;        // pixels of the patch; it lies within the picture
  uint width;        // of the picture, px
  uint seed;         // of the run
  uint step;         // of the training
} push;
void main() {
  uint i = thread_index();
  if (i >= visible_count[0]) return;
  uint anchor = visible[i];
  vec3 p = from_center(position[anchor], push.center, push.center_low);
  precise float x = (push.rotation0.x * p.x + push.rotation0.y * p.y) + push.rotation0.z * p.z;
  precise float y = (push.rotation1.x * p.x + push.rotation1.y * p.y) + push.rotation1.z * p.z;
  precise float z = (push.rotation2.x * p.x + push.rotation2.y * p.y) + push.rotation2.z * p.z;
  vec2 pixel;
  uint side = 2u;
  vec2 low = vec2(push.corner), high = vec2(push.corner + push.side);
  if (patch_pixel(vec3(x, y, z), push.near, push.max_radius2, push.lens, push.distortion, pixel)
      && all(greaterThanEqual(pixel, low)) && all(lessThan(pixel, high))) {
    uvec2 at = uvec2(pixel);
    side = (picture[at.y * push.width + at.x] >> 24u) >= 128u ? 0u : 1u;
    atomicAdd(candidates[side], 1u);
  }
  keys[i] = side << 30u | random_key(push.seed, push.step, anchor) >> 2u;
  anchors[i] = anchor;
}
