#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "alignable.glsl"
// Sums for the gradient through the fit: by q, and by |w| about the mean.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer GradAligned { float grad_aligned[]; }; // [pixel] of all depth losses
layout(binding = 1, scalar) readonly buffer Rendered { float rendered[]; };        // [pixel] rendered depth
layout(binding = 2, scalar) readonly buffer Fit { float fit[]; };                  // [11] of `align_fit`
layout(binding = 3, scalar) writeonly buffer Partial { float partial[]; };         // [2 * group] sums of: grad_aligned, grad_aligned * dx with dx in units
layout(push_constant, scalar) uniform Push {
  uint pixels; // width * height
  float near;  // of disparities; 0: the prior is a depth
} push;
void main() {
  vec4 sums = vec4(0.0);
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= push.pixels) break;
    float g = grad_aligned[pixel];
    sums.xy += vec2(g, g * ((alignable(rendered[pixel], push.near) - fit[2] - fit[9]) * fit[8]));
  }
  vec4 total = group_sum(sums);
  uint groups = (push.pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total.x;
    partial[groups + group_index()] = total.y;
  }
}
