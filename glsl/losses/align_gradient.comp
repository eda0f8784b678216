#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "alignable.glsl"
// variant masked: MASKED
// The depth losses' gradient by the rendered depth, directly and through w and q, with x the rendered value,
// dx and dp the distances from the valid pixels' means, S = sum dx^2 and n the valid pixels:
// dw/dx_i = valid (dp_i - 2 w dx_i) / S,  dq/dx_i = -mean(x) dw/dx_i - valid w / n.
// S and what is summed with dx is in units of x, which keep it in float32's range.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer GradAligned { float grad_aligned[]; }; // [pixel] of all depth losses
layout(binding = 1, scalar) readonly buffer Rendered { float rendered[]; };        // [pixel] rendered depth
layout(binding = 2, scalar) readonly buffer Prior { float prior[]; };              // [pixel] prior depth or disparity
layout(binding = 3, scalar) readonly buffer Fit { float fit[]; };                  // [11] of `align_fit`
layout(binding = 4, scalar) readonly buffer Sums { float sums[]; };                // [2] of `align_backward`
layout(binding = 5, scalar) writeonly buffer GradDepth { float grad_depth[]; };    // [pixel] of all depth losses by the rendered depth
#ifdef MASKED
layout(binding = 6, scalar) readonly buffer Valid { float valid[]; }; // [pixel] 1 where the fit looks
#endif
layout(push_constant, scalar) uniform Push {
  uint pixels; // width * height
  float near;  // of disparities; 0: the prior is a depth
} push;
void main() {
  uint pixel = thread_index();
  if (pixel >= push.pixels) return;
  float scale = fit[0], mean = fit[2], slope = fit[4], unit = fit[8];
  float grad_shift = sums[0];
  float about_mean = sums[1];
  // sign(w) grad_|w| - mean grad_q, written about the mean: for w > 0 the mean drops out.
  float grad_slope = sign(slope) * about_mean + (sign(slope) - 1.0) * (mean * unit) * grad_shift;
  float dx = alignable(rendered[pixel], push.near) - mean - fit[9];
  float dp = prior[pixel] - fit[6] - fit[10];
  float through_fit =
      grad_slope * fit[5] * unit * (dp - 2.0 * slope * dx) - slope * grad_shift * fit[7];
#ifdef MASKED
  through_fit *= valid[pixel];
#endif
  float grad = scale * grad_aligned[pixel] + through_fit;
  grad_depth[pixel] = grad * alignable_slope(rendered[pixel], push.near);
}
