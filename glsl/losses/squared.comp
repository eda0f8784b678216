#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
// Squared difference between the render and the photograph, added to the gradient by the render.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rgb { vec3 rgb[]; };           // [pixel] the render
layout(binding = 1, scalar) readonly buffer Target { vec3 target[]; };     // [pixel] the photograph
layout(binding = 2, scalar) buffer GradRgb { vec3 grad_rgb[]; };           // [pixel] of the losses so far by the render
layout(binding = 3, scalar) writeonly buffer Partial { float partial[]; }; // [group] the loss
layout(push_constant, scalar) uniform Push {
  uint pixels;  // width * height
  float factor; // of the square: the loss's weight / (3 pixels)
} push;
void main() {
  float loss = 0.0;
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= push.pixels) break;
    vec3 d = rgb[pixel] - target[pixel];
    grad_rgb[pixel] += 2.0 * push.factor * d;
    loss += push.factor * dot(d, d);
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (push.pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total;
  }
}
