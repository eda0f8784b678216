#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "alignable.glsl"
// variant weighted: WEIGHTED
// Weighted L1 between aligned depth and prior, and what the other depth losses start from: the difference.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rendered { float rendered[]; };      // [pixel] rendered depth
layout(binding = 1, scalar) readonly buffer Prior { float prior[]; };            // [pixel] prior depth or disparity
layout(binding = 2, scalar) readonly buffer Fit { float fit[]; };                // [11] of `align_fit`
layout(binding = 3, scalar) writeonly buffer Difference { float difference[]; }; // [pixel] aligned - prior
layout(binding = 4, scalar) writeonly buffer GradAligned { float grad_aligned[]; }; // [pixel] of the loss by the aligned value
layout(binding = 5, scalar) writeonly buffer Partial { float partial[]; };       // [group] the loss
#ifdef WEIGHTED
layout(binding = 6, scalar) readonly buffer Weight { float weight[]; }; // [pixel] weight of the pixel
#endif
layout(push_constant, scalar) uniform Push {
  uint pixels;  // width * height
  float near;   // of disparities; 0: the prior is a depth
  float factor; // of the absolute difference: 1 / pixels, times the weight of all pixels if they have none of their own
} push;
void main() {
  float loss = 0.0;
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= push.pixels) break;
    float x = alignable(rendered[pixel], push.near);
    // Distances from the means first: neither x nor prior loses digits to how far from zero they are.
    float d = fit[0] * (x - fit[2]) - (prior[pixel] - fit[6]) + fit[3];
    float scale = push.factor;
#ifdef WEIGHTED
    scale *= weight[pixel];
#endif
    difference[pixel] = d;
    grad_aligned[pixel] = scale * sign(d);
    loss += scale * abs(d);
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (push.pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total;
  }
}
