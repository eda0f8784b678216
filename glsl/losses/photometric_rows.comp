#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "ssim.glsl"
// SSIM's moments along rows. A thread makes RUN neighbouring pixels of one channel, so that a sample is loaded once
// for all of them.
const int RUN = 8;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Rendered { vec3 rendered[]; }; // [pixel] rgb
layout(binding = 1, scalar) readonly buffer Target { vec3 target[]; };     // [pixel] rgb
layout(binding = 2, scalar) writeonly buffer Moments { vec4 moments[]; };  // [pixel * 3] along the row: both means, sum of both variances, covariance
layout(push_constant, scalar) uniform Push {
  uvec2 size; // width, height in pixels
} push;
void main() {
  uint runs = (push.size.x + RUN - 1u) / RUN;
  uint t = thread_index();
  uint channel = t % 3u;
  int start = int(t / 3u % runs) * RUN;
  uint y = t / 3u / runs;
  if (y >= push.size.y) return;
  int width = int(push.size.x);
  uint row = y * push.size.x;
  // Variances do not change with a shift of all samples (of the zeros outside the picture too). Near the run's own
  // values the differences are small, and E[d^2] - E[d]^2 loses digits of the contrast only, not of the brightness.
  uint middle = row + uint(min(start + RUN / 2, width - 1));
  vec2 shift = vec2(rendered[middle][channel], target[middle][channel]);
  vec4 sums[RUN];
  [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec4(0.0);
  [[unroll]] for (int i = -RADIUS; i < RUN + RADIUS; ++i) {
    int x = start + i;
    vec2 d = -shift;
    if (x >= 0 && x < width) d += vec2(rendered[row + uint(x)][channel], target[row + uint(x)][channel]);
    vec4 term = vec4(d, dot(d, d), d.x * d.y);
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      int k = i - o + RADIUS;
      if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * term;
    }
  }
  [[unroll]] for (int o = 0; o < RUN; ++o) {
    if (start + o < width) {
      vec4 s = sums[o];
      vec4 m = vec4(shift + s.xy, max(s.z - dot(s.xy, s.xy), 0.0), s.w - s.x * s.y);
      moments[(row + uint(start + o)) * 3u + channel] = m;
    }
  }
}
