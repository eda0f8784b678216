#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "ssim.glsl"
// The window's adjoint along rows: the same symmetric window, since nothing lies outside the picture.
const int RUN = 8;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer GradMoments { vec3 grad_moments[]; }; // [pixel * 3] of `photometric_columns`
layout(binding = 1, scalar) writeonly buffer GradRows { vec3 grad_rows[]; };       // [pixel * 3] the same, blurred along rows
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
  vec3 sums[RUN];
  [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec3(0.0);
  [[unroll]] for (int i = -RADIUS; i < RUN + RADIUS; ++i) {
    int x = start + i;
    vec3 g = vec3(0.0);
    if (x >= 0 && x < width) g = grad_moments[(row + uint(x)) * 3u + channel];
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      int k = i - o + RADIUS;
      if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * g;
    }
  }
  [[unroll]] for (int o = 0; o < RUN; ++o)
    if (start + o < width) grad_rows[(row + uint(start + o)) * 3u + channel] = sums[o];
}
