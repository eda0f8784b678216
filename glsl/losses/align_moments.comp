#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "alignable.glsl"
// variant masked: MASKED
// Second pass of the fit: moments about the first pass's means, and the means' own rounding error.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rendered { float rendered[]; }; // [pixel] rendered depth
layout(binding = 1, scalar) readonly buffer Prior { float prior[]; };       // [pixel] prior depth or disparity
layout(binding = 2, scalar) readonly buffer Sums { float sums[]; };         // [3] of `align_means`
layout(binding = 3, scalar) writeonly buffer Partial { float partial[]; };  // [4 * group] sums of valid times: dx, dp, dx^2, dx dp, with dx in `alignable_unit`s
#ifdef MASKED
layout(binding = 4, scalar) readonly buffer Valid { float valid[]; }; // [pixel] 1 where the fit looks
#endif
layout(push_constant, scalar) uniform Push {
  uint pixels; // width * height
  float near;  // of disparities; 0: the prior is a depth
} push;
void main() {
  // Without a valid pixel every term is zero.
  float inverse = sums[0] > 0.0 ? 1.0 / sums[0] : 0.0;
  precise vec2 mean = vec2(sums[1], sums[2]) * inverse; // as in `align_fit`
  float unit = alignable_unit(sums[0], sums[1]);
  vec4 moments = vec4(0.0);
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= push.pixels) break;
    vec2 d = vec2(alignable(rendered[pixel], push.near), prior[pixel]) - mean;
    d.x *= unit;
    vec4 term = vec4(d, d.x * d.x, d.x * d.y);
#ifdef MASKED
    term *= valid[pixel];
#endif
    moments += term;
  }
  vec4 total = group_sum(moments);
  uint groups = (push.pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total.x;
    partial[groups + group_index()] = total.y;
    partial[2u * groups + group_index()] = total.z;
    partial[3u * groups + group_index()] = total.w;
  }
}
