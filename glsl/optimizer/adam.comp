#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// One Adam step on the elements offset .. offset + n of flat arrays. The square root of the second moment is kept
// instead of the moment: g * g leaves float32's range below 1e-19 and above 1e19, a hypotenuse of |g| never does.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Overflow { uint overflow[]; }; // [1] sticky: not 0 skips the step
layout(binding = 1, scalar) readonly buffer Gradient { float gradient[]; }; // [elements] dL/dvalue
layout(binding = 2, scalar) buffer Value { float value[]; };                // [elements] the parameters
layout(binding = 3, scalar) buffer First { float first[]; };                // [elements] first moment
layout(binding = 4, scalar) buffer Root { float root[]; };                  // [elements] square root of the second moment
layout(push_constant, scalar) uniform Push {
  uint offset;             // first element
  uint n;                  // elements from there
  float rate;              // learning rate
  float epsilon;           // added to the root of the corrected second moment
  float beta1;             // decay of the first moment
  float complement1;       // 1 - beta1
  float root_decay;        // 1 - sqrt(beta2)
  float root_complement;   // sqrt(1 - beta2)
  float correction;        // 1 / (1 - beta1^t)
  float root_correction;   // sqrt(1 / (1 - beta2^t))
} push;
const uint ELEMENTS = 8u; // per thread, a group apart so that neighbours stay neighbours
void main() {
  if (overflow[0] != 0u) return;
  uint at = group_index() * (gl_WorkGroupSize.x * ELEMENTS) + gl_LocalInvocationID.x;
  for (uint k = 0u; k < ELEMENTS; k++, at += gl_WorkGroupSize.x) {
    if (at >= push.n) return;
    uint i = push.offset + at;
    float g = gradient[i];
    float m = push.beta1 * first[i] + push.complement1 * g;
    float old = root[i];
    float a = old - push.root_decay * old; // sqrt(beta2) * old: the small constant carries more digits of beta2
    float b = push.root_complement * abs(g);
    float large = max(a, b), ratio = min(a, b) / max(large, 1e-37); // both 0: 0. Below 1e-37 epsilon decides alone
    float r = large * sqrt(1.0 + ratio * ratio);
    value[i] -= push.rate * ((push.correction * m) / (push.root_correction * r + push.epsilon));
    first[i] = m;
    root[i] = r;
  }
}
