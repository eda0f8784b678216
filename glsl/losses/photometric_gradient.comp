#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "ssim.glsl"
// variant weighted: WEIGHTED
// variant weighted_outside: WEIGHTED OUTSIDE
// variant l1: NO_SSIM
// variant l1_weighted: NO_SSIM WEIGHTED
// The window's adjoint along columns, SSIM's gradient by the rendered values, and L1: its loss and gradient. `l1` is for
// losses without SSIM; with `outside` pixels without weight have no gradient, though windows beside them reach in.
const int RUN = 8;
layout(local_size_x = 64) in;
#ifndef NO_SSIM
layout(binding = 0, scalar) readonly buffer GradRows { vec3 grad_rows[]; };        // [pixel * 3] of `photometric_adjoint`
#endif
layout(binding = 1, scalar) readonly buffer Rendered { vec3 rendered[]; };         // [pixel] rgb
layout(binding = 2, scalar) readonly buffer Target { vec3 target[]; };             // [pixel] rgb
layout(binding = 3, scalar) writeonly buffer GradRendered { vec3 grad_rendered[]; }; // [pixel] of the whole photometric loss
layout(binding = 4, scalar) writeonly buffer Partial { float partial[]; };         // [first + group] this part of the loss
#ifdef WEIGHTED
layout(binding = 5, scalar) readonly buffer Weight { float weight[]; }; // [pixel] weight of the pixel
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size;   // width, height in pixels
  float factor; // of the absolute difference: its share of the loss / (3 pixels)
  uint first;   // where this part of the loss begins in `partial`
} push;
void main() {
  uint x = thread_index() % push.size.x;
  int start = int(thread_index() / push.size.x) * RUN;
  int height = int(push.size.y);
  float loss = 0.0;
  if (start < height) {
#ifndef NO_SSIM
    // One channel after the other: its 24 sums stay near, and rgb is read and written whole.
    vec3 second[RUN], mixed[RUN], grad[RUN];
    [[unroll]] for (int c = 0; c < 3; ++c) {
      vec3 sums[RUN];
      [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec3(0.0);
      [[unroll]] for (int i = -RADIUS; i < RUN + RADIUS; ++i) {
        int y = start + i;
        vec3 g = vec3(0.0);
        if (y >= 0 && y < height) g = grad_rows[(uint(y) * push.size.x + x) * 3u + c];
        [[unroll]] for (int o = 0; o < RUN; ++o) {
          int k = i - o + RADIUS;
          if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * g;
        }
      }
      [[unroll]] for (int o = 0; o < RUN; ++o) {
        grad[o][c] = sums[o].x;
        second[o][c] = sums[o].y;
        mixed[o][c] = sums[o].z;
      }
    }
#endif
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      if (start + o < height) {
        uint pixel = uint(start + o) * push.size.x + x;
        vec3 a = rendered[pixel];
        vec3 difference = a - target[pixel];
        float scale = push.factor;
#ifdef WEIGHTED
        scale *= weight[pixel];
#endif
#ifdef OUTSIDE
        if (scale == 0.0) {
          grad_rendered[pixel] = vec3(0.0);
          continue;
        }
#endif
        loss += scale * (abs(difference.r) + abs(difference.g) + abs(difference.b));
        vec3 gradient = scale * sign(difference);
#ifndef NO_SSIM
        gradient = grad[o] + 2.0 * ((a - 0.5) * second[o] + difference * mixed[o]) + gradient;
#endif
        grad_rendered[pixel] = gradient;
      }
    }
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (push.size.x * ((push.size.y + RUN - 1u) / RUN) + 63u) / 64u;
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) partial[push.first + group_index()] = total;
}
