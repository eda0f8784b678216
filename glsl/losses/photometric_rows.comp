#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "ssim.glsl"
// variant outside: OUTSIDE
// variant wide: RUN=4
// variant outside_wide: OUTSIDE RUN=4
// SSIM's moments along rows. A thread makes RUN neighbouring pixels, so that a sample is loaded once for all of them.
// `outside` takes pixels without weight as if both pictures agreed there: the window of a pixel beside the mask does not
// compare what is behind the object with the object. `wide` is for GPUs: samples of fewer pixels fit the registers.
#ifndef RUN
#define RUN 8
#endif
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rendered { vec3 rendered[]; }; // [pixel] rgb
layout(binding = 1, scalar) readonly buffer Target { vec3 target[]; };     // [pixel] rgb
layout(binding = 2, scalar) writeonly buffer Moments { vec4 moments[]; };  // [pixel * 3] along the row: mean rendered, mean difference, sum of both variances, variance of the difference
#ifdef OUTSIDE
layout(binding = 3, scalar) readonly buffer Weight { float weight[]; };   // [pixel] of the photometric loss
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size; // width, height in pixels
} push;
void main() {
  uint runs = (push.size.x + RUN - 1u) / RUN;
  int start = int(thread_index() % runs) * RUN;
  uint y = thread_index() / runs;
  if (y >= push.size.y) return;
  int width = int(push.size.x);
  uint row = y * push.size.x;
  vec3 a[RUN + 2 * RADIUS], difference[RUN + 2 * RADIUS];
  [[unroll]] for (int i = 0; i < RUN + 2 * RADIUS; ++i) {
    int x = start + i - RADIUS;
    a[i] = vec3(0.0);
    difference[i] = vec3(0.0);
    if (x >= 0 && x < width) {
      a[i] = rendered[row + uint(x)];
      difference[i] = a[i] - target[row + uint(x)];
#ifdef OUTSIDE
      if (weight[row + uint(x)] == 0.0) difference[i] = vec3(0.0);
#endif
    }
  }
  [[unroll]] for (int c = 0; c < 3; ++c) {
    // Variances do not change with a shift of all samples (of the zeros outside the picture too). Near the run's own
    // values the distances are small, and E[d^2] - E[d]^2 loses digits of the contrast only, not of the brightness.
    vec2 shift = vec2(a[RADIUS][c], difference[RADIUS][c]);
    if (start + RUN / 2 < width) shift = vec2(a[RADIUS + RUN / 2][c], difference[RADIUS + RUN / 2][c]);
    vec4 sums[RUN];
    [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec4(0.0);
    [[unroll]] for (int i = 0; i < RUN + 2 * RADIUS; ++i) {
      vec2 d = vec2(a[i][c], difference[i][c]) - shift;
      float b = d.x - d.y;
      vec4 term = vec4(d, d.x * d.x + b * b, d.y * d.y);
      [[unroll]] for (int o = 0; o < RUN; ++o)
        if (i >= o && i <= o + 2 * RADIUS) sums[o] += WINDOW[i - o] * term;
    }
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      if (start + o < width) {
        vec4 s = sums[o];
        float b = s.x - s.y;
        vec2 variances = max(s.zw - vec2(s.x * s.x + b * b, s.y * s.y), 0.0);
        moments[(row + uint(start + o)) * 3u + c] = vec4(shift + s.xy, variances);
      }
    }
  }
}
