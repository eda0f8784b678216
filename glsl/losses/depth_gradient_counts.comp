#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
// Valid pixels of each scale: scale s takes every 2^s-th pixel of every 2^s-th line.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Valid { float valid[]; };      // [pixel] 1 where the loss looks
layout(binding = 1, scalar) writeonly buffer Partial { float partial[]; }; // [scale * group] sums of valid
layout(push_constant, scalar) uniform Push {
  uvec2 size;  // width, height in pixels
  uint scales; // at most 8
} push;
void main() {
  uint pixels = push.size.x * push.size.y;
  vec4 fine = vec4(0.0), coarse = vec4(0.0);
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= pixels) break;
    uvec2 at = uvec2(pixel % push.size.x, pixel / push.size.x);
    int last = findLSB(at.x | at.y | 128u); // the coarsest scale that has the pixel
    vec4 v = vec4(valid[pixel]);
    fine += mix(vec4(0.0), v, lessThanEqual(ivec4(0, 1, 2, 3), ivec4(last)));
    coarse += mix(vec4(0.0), v, lessThanEqual(ivec4(4, 5, 6, 7), ivec4(last)));
  }
  fine = group_sum(fine);
  coarse = group_sum(coarse);
  uint groups = (pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    for (uint s = 0u; s < min(push.scales, 8u); ++s)
      partial[s * groups + group_index()] = s < 4u ? fine[s] : coarse[s - 4u];
  }
}
