#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// One Adam step on the elements first_element .. first_element + n of flat float arrays, bound as vectors of four: the
// step is bound by memory. The square root of the second moment is kept instead of the moment: g * g leaves float32's
// range, a hypotenuse of |g| never does.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Overflow { uint overflow[]; }; // [1] sticky: not 0 skips the step
layout(binding = 1, scalar) readonly buffer Gradient { vec4 gradient[]; }; // [elements / 4] dL/dvalue
layout(binding = 2, scalar) buffer Value { vec4 value[]; };                // [elements / 4] the parameters
layout(binding = 3, scalar) buffer First { vec4 first[]; };                // [elements / 4] first moment
layout(binding = 4, scalar) buffer Root { vec4 root[]; };                  // [elements / 4] root of the second moment
layout(push_constant, scalar) uniform Push {
  uint offset;             // first element
  uint n;                  // elements from there
  vec3 rate;               // learning rate: of the first part, of the second, of the third
  uvec2 parts;             // where the second part and the third begin
  float epsilon;           // added to the root of the corrected second moment
  float complement1;       // 1 - beta1
  float root_decay;        // 1 - sqrt(beta2)
  float root_complement;   // sqrt(1 - beta2)
  float correction;        // 1 / (1 - beta1^t)
  float root_correction;   // sqrt(1 / (1 - beta2^t))
} push;
const uint VECTORS = 4u; // per thread, a group apart so that neighbours stay neighbours
void main() {
  if (overflow[0] != 0u) return;
  // CPU drivers load a push constant again for every lane wherever it is read in a loop.
  uint offset = push.offset, end = offset + push.n;
  vec3 rates = push.rate;
  uvec2 parts = push.parts;
  float epsilon = push.epsilon, complement1 = push.complement1;
  float root_decay = push.root_decay, root_complement = push.root_complement;
  float correction = push.correction, root_correction = push.root_correction;
  uint i = offset / 4u + group_index() * (gl_WorkGroupSize.x * VECTORS) + gl_LocalInvocationID.x;
  for (uint k = 0u; k < VECTORS; k++, i += gl_WorkGroupSize.x) {
    if (4u * i >= end) return;
    vec4 g = gradient[i], old_value = value[i], old_first = first[i], old_root = root[i];
    // beta1 m + (1 - beta1) g by one constant: rounded apart, the two do not sum to one, and the moment of a steady gradient
    // strays by up to 2^-25 / (1 - beta1) of itself. So it stays within a unit in the last place.
    vec4 m = old_first - complement1 * old_first + complement1 * g;
    vec4 a = old_root - root_decay * old_root; // sqrt(beta2) r: the small constant carries more digits of beta2
    vec4 b = root_complement * abs(g);
    vec4 large = max(a, b), ratio = min(a, b) / max(large, vec4(1e-37)); // both 0: 0; below 1e-37 epsilon decides alone
    vec4 r = large * sqrt(1.0 + ratio * ratio);
    // Largest and smallest pass over what is not a number: a lost moment or gradient must not look whole again.
    vec4 sum = a + b;
    r = mix(r, sum, equal(floatBitsToUint(sum) & 0x7f800000u, uvec4(0x7f800000u)));
    vec4 rate = vec4(rates.x);
    if (4u * i + 3u >= parts.x) {
      uvec4 element = 4u * i + uvec4(0, 1, 2, 3);
      rate = mix(rate, vec4(rates.y), greaterThanEqual(element, uvec4(parts.x)));
      rate = mix(rate, vec4(rates.z), greaterThanEqual(element, uvec4(parts.y)));
    }
    vec4 v = old_value - rate * ((correction * m) / (root_correction * r + epsilon));
    if (4u * i < offset || 4u * i + 4u > end) { // the ends of a range that starts or stops within a vector
      uvec4 element = 4u * i + uvec4(0, 1, 2, 3);
      bvec4 inside = bvec4(uvec4(greaterThanEqual(element, uvec4(offset))) & uvec4(lessThan(element, uvec4(end))));
      v = mix(old_value, v, inside);
      m = mix(old_first, m, inside);
      r = mix(old_root, r, inside);
    }
    value[i] = v;
    first[i] = m;
    root[i] = r;
  }
}
