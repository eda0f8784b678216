#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "ssim.glsl"
// variant weighted: WEIGHTED
// SSIM's moments along columns, SSIM, its part of the loss, and the loss's derivatives by the window's mean of the
// rendered values, the sum of both second moments about 1/2, and the second moment of the difference.
const int RUN = 8;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Moments { vec4 moments[]; };   // [pixel * 3] of `photometric_rows`
layout(binding = 1, scalar) writeonly buffer GradMoments { vec3 grad_moments[]; }; // [pixel * 3] of the loss by these three
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
      // Law of total variance: the rows' variances, and their means'.
      vec2 d = m.xy - shift;
      float b = d.x - d.y;
      vec4 term = vec4(d, m.z + d.x * d.x + b * b, m.w + d.y * d.y);
      [[unroll]] for (int o = 0; o < RUN; ++o) {
        int k = i - o + RADIUS;
        if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * term;
      }
    }
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      if (start + o < height) {
        vec4 s = sums[o];
        uint at = uint(start + o) * line + x;
        float b = s.x - s.y;
        vec2 variances = max(s.zw - vec2(s.x * s.x + b * b, s.y * s.y), 0.0);
        float mean = shift.x + s.x;
        float difference = shift.y + s.y;
        b = mean - difference;
        // With u, v = the means' and the structure's distance from one, SSIM = (1 - u)(1 - v): nothing cancels where
        // the pictures agree. Both denominators are at least C1 and C2.
        float inverse1 = 1.0 / (mean * mean + b * b + C1);
        float inverse2 = 1.0 / (variances.x + C2);
        float u = difference * difference * inverse1;
        float v = variances.y * inverse2;
        float by_sum = (1.0 - u) * v * inverse2;
        float by_difference = (u - 1.0) * inverse2;
        float by_mean = 2.0 * inverse1 * (1.0 - v) * (mean * u - difference);
        vec3 by = vec3(by_mean - 2.0 * ((mean - 0.5) * by_sum + difference * by_difference), by_sum, by_difference);
        float scale = push.factor;
#ifdef WEIGHTED
        scale *= weight[at / 3u];
#endif
        grad_moments[at] = -scale * by;
        loss += scale * (u + v - u * v);
      }
    }
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (line * ((push.size.y + RUN - 1u) / RUN) + 63u) / 64u;
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) partial[group_index()] = total;
}
