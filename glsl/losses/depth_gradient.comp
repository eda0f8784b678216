#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "group_sum.glsl"
// variant masked: MASKED
// Total variation of the depth difference at several scales (GScream, equation 6): the sum over scale s of
// 1 / sum(mask) sum |grad(mask difference)| over pixels 2^s apart. A thread gathers from its pixel's four neighbours.
// A workgroup takes RUN times 64 pixels in a row.
const uint RUN = 8u;
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Difference { float difference[]; };  // [pixel] aligned - prior
layout(binding = 1, scalar) buffer GradAligned { float grad_aligned[]; };        // [pixel] added to
layout(binding = 2, scalar) writeonly buffer Partial { float partial[]; };       // [group] the loss
#ifdef MASKED
layout(binding = 3, scalar) readonly buffer Valid { float valid[]; };   // [pixel] 1 where the loss looks
layout(binding = 4, scalar) readonly buffer Counts { float counts[]; }; // [scale] sums of valid
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size;   // width, height in pixels
  float factor; // of the whole loss
  uint scales;  // at most 8
} push;
struct Sample { float mask; float value; };
Sample sample_at(uint x, uint y) {
  uint pixel = y * push.size.x + x;
#ifdef MASKED
  float mask = valid[pixel];
  return Sample(mask, mask * difference[pixel]);
#else
  return Sample(1.0, difference[pixel]);
#endif
}
void main() {
  uint pixels = push.size.x * push.size.y;
  float loss = 0.0;
  for (uint i = 0u; i < RUN; ++i) {
    uint pixel = (group_index() * RUN + i) * 64u + gl_LocalInvocationID.x;
    if (pixel >= pixels) break;
    uint x = pixel % push.size.x;
    uint y = pixel / push.size.x;
    Sample here = sample_at(x, y);
    float grad = 0.0;
    for (uint s = 0u; s < push.scales; ++s) {
      uint step = 1u << s;
      if (((x | y) & (step - 1u)) != 0u) break; // nor has a coarser scale this pixel
#ifdef MASKED
      float count = counts[s];
      if (count == 0.0) break; // nor has a coarser scale a valid pixel
#else
      float count = float((push.size.x + step - 1u) / step) * float((push.size.y + step - 1u) / step);
#endif
      float scale = push.factor / count * here.mask;
      float sum = 0.0;
      if (x >= step) {
        Sample other = sample_at(x - step, y);
        sum += other.mask * sign(here.value - other.value);
      }
      if (y >= step) {
        Sample other = sample_at(x, y - step);
        sum += other.mask * sign(here.value - other.value);
      }
      if (x + step < push.size.x) {
        Sample other = sample_at(x + step, y);
        sum += other.mask * sign(here.value - other.value);
        loss += scale * other.mask * abs(here.value - other.value);
      }
      if (y + step < push.size.y) {
        Sample other = sample_at(x, y + step);
        sum += other.mask * sign(here.value - other.value);
        loss += scale * other.mask * abs(here.value - other.value);
      }
      grad += scale * sum;
    }
    grad_aligned[pixel] += here.mask * grad;
  }
  float total = group_sum(vec4(loss, 0.0, 0.0, 0.0)).x;
  uint groups = (pixels + 64u * RUN - 1u) / (64u * RUN);
  if (gl_LocalInvocationID.x == 0u && group_index() < groups) {
    partial[group_index()] = total;
  }
}
