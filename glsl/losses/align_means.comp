#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "alignable.glsl"
// variant masked: MASKED
// First pass of the fit: sums of the valid pixels' weights, rendered values and priors.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rendered { float rendered[]; }; // [pixel] rendered depth
layout(binding = 1, scalar) readonly buffer Prior { float prior[]; };       // [pixel] prior depth or disparity
layout(binding = 2, scalar) writeonly buffer Partial { float partial[]; };  // [3 * group] sums of: valid, valid * x, valid * prior
#ifdef MASKED
layout(binding = 3, scalar) readonly buffer Valid { float valid[]; }; // [pixel] 1 where the fit looks
#endif
layout(push_constant, scalar) uniform Push {
  uint pixels; // width * height
  float near;  // of disparities; 0: the prior is a depth
} push;
void main() {
  vec4 sums = vec4(0.0);
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= push.pixels) break;
    vec4 term = vec4(1.0, alignable(rendered[pixel], push.near), prior[pixel], 0.0);
#ifdef MASKED
    term *= valid[pixel];
#endif
    sums += term;
  }
  vec4 total = group_sum(sums);
  uint groups = (push.pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total.x;
    partial[groups + group_index()] = total.y;
    partial[2u * groups + group_index()] = total.z;
  }
}
