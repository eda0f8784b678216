#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
#include "ssim.glsl"
// variant weighted: WEIGHTED
// The window's adjoint along columns, SSIM's gradient by the rendered values, and L1: its loss and gradient.
const int RUN = 8;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer GradRows { vec3 grad_rows[]; };        // [pixel * 3] of `photometric_adjoint`
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
  uint line = push.size.x * 3u;
  uint t = thread_index();
  uint x = t % line;
  int start = int(t / line) * RUN;
  int height = int(push.size.y);
  float loss = 0.0;
  if (start < height) {
    vec3 sums[RUN];
    [[unroll]] for (int o = 0; o < RUN; ++o) sums[o] = vec3(0.0);
    [[unroll]] for (int i = -RADIUS; i < RUN + RADIUS; ++i) {
      int y = start + i;
      vec3 g = vec3(0.0);
      if (y >= 0 && y < height) g = grad_rows[uint(y) * line + x];
      [[unroll]] for (int o = 0; o < RUN; ++o) {
        int k = i - o + RADIUS;
        if (k >= 0 && k <= 2 * RADIUS) sums[o] += WINDOW[k] * g;
      }
    }
    uint channel = x % 3u;
    [[unroll]] for (int o = 0; o < RUN; ++o) {
      if (start + o < height) {
        uint pixel = uint(start + o) * push.size.x + x / 3u;
        float a = rendered[pixel][channel];
        float b = target[pixel][channel];
        float scale = push.factor;
#ifdef WEIGHTED
        scale *= weight[pixel];
#endif
        loss += scale * abs(a - b);
        vec3 s = sums[o];
        grad_rendered[pixel][channel] = s.x + 2.0 * (a - 0.5) * s.y + (b - 0.5) * s.z + scale * sign(a - b);
      }
    }
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (line * ((push.size.y + RUN - 1u) / RUN) + 63u) / 64u;
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) partial[push.first + group_index()] = total;
}
