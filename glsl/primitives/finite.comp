#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// variant gated: GATED
// Raises the sticky flag if any of n floats is NaN or infinite. The floats are looked at as words: compilers may assume
// that arithmetic meets neither. Every group that finds one sets the same bit, in whatever order. Where the flag is up
// already, the floats are those of a step that did not fit, and nobody will use them.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Values { uvec4 values[]; }; // [n / 4] floats by their bits
layout(binding = 1, scalar) buffer Flag { uint flag[]; };               // [1] sticky, not 0: the step is not taken
#ifdef GATED
layout(binding = 2, scalar) readonly buffer Gate { uint gate[]; };      // [1] 0: nothing was written into the values
#endif
layout(push_constant, scalar) uniform Push {
  uint n;   // floats
  uint bit; // of the flag
} push;
const uint VECTORS = 4u; // per thread, a group apart so that neighbours stay neighbours
const uint EXPONENT = 0x7f800000u;
void main() {
  if (flag[0] != 0u) return;
#ifdef GATED
  if (gate[0] == 0u) return;
#endif
  uint i = group_index() * (gl_WorkGroupSize.x * VECTORS) + gl_LocalInvocationID.x;
  bool found = false;
  for (uint k = 0u; k < VECTORS && 4u * i < push.n; k++, i += gl_WorkGroupSize.x) {
    bvec4 broken = equal(values[i] & EXPONENT, uvec4(EXPONENT));
    bvec4 inside = lessThan(4u * i + uvec4(0, 1, 2, 3), uvec4(push.n));
    found = found || any(bvec4(uvec4(broken) & uvec4(inside)));
  }
  if (found) atomicOr(flag[0], 1u << push.bit);
}
