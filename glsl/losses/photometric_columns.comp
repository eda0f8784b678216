#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "ssim.glsl"
// variant weighted: WEIGHTED
// SSIM's moments along columns, SSIM, its part of the loss, and the loss's derivatives by the window's mean of the
// rendered values, their second moment and the mixed second moment.
const int RUN = 8;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Moments { vec4 moments[]; };   // [pixel * 3] of `photometric_rows`
layout(binding = 1, scalar) writeonly buffer GradMoments { vec3 grad_moments[]; }; // [pixel * 3] by the mean, the second moment, the mixed second moment, about 1/2
layout(binding = 2, scalar) writeonly buffer Partial { float partial[]; }; // [group] this part of the loss
#ifdef WEIGHTED
layout(binding = 3, scalar) readonly buffer Weight { float weight[]; }; // [pixel] weight of the pixel
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size;   // width, height in pixels
  float factor; // of 1 - SSIM: its share of the loss / (3 pixels)
} push;
void main() {
  uint line = push.size.x * 3u;
  uint t = thread_index();
  uint x = t % line;
  int start = int(t / line) * RUN;
  int height = int(push.size.y);
  float loss = 0.0;
  if (start < height) {
    vec2 shift = moments[uint(min(start + RUN / 2, height - 1)) * line + x].xy;
    vec4 sums[RUN];
    [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec4(0.0);
    [[unroll]] for (int i = -RADIUS; i < RUN + RADIUS; ++i) {
      int y = start + i;
      vec4 m = vec4(0.0);
      if (y >= 0 && y < height) m = moments[uint(y) * line + x];
      // Law of total variance: of the rows' variances and means.
      vec2 d = m.xy - shift;
      vec4 term = vec4(d, m.z + dot(d, d), m.w + d.x * d.y);
      [[unroll]] for (int o = 0; o < RUN; ++o) {
        int k = i - o + RADIUS;
        if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * term;
      }
    }
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      if (start + o < height) {
        vec4 s = sums[o];
        uint at = uint(start + o) * line + x;
        vec2 mean = shift + s.xy;
        float variances = max(s.z - dot(s.xy, s.xy), 0.0);
        float covariance = s.w - s.x * s.y;
        // Both denominators are at least C1 and C2.
        float inverse1 = 1.0 / (dot(mean, mean) + C1);
        float inverse2 = 1.0 / (variances + C2);
        float means = (2.0 * mean.x * mean.y + C1) * inverse1;
        float structure = (2.0 * covariance + C2) * inverse2;
        float ssim = means * structure;
        float by_second = -ssim * inverse2;
        float by_mixed = 2.0 * means * inverse2;
        float by_mean = 2.0 * inverse1 * (mean.y * structure - mean.x * ssim);
        vec3 by = vec3(by_mean - 2.0 * (mean.x - 0.5) * by_second - (mean.y - 0.5) * by_mixed, by_second, by_mixed);
        float scale = push.factor;
#ifdef WEIGHTED
        scale *= weight[at / 3u];
#endif
        grad_moments[at] = -scale * by;
        loss += scale * (1.0 - ssim);
      }
    }
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (line * ((push.size.y + RUN - 1u) / RUN) + 63u) / 64u;
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) partial[group_index()] = total;
}
