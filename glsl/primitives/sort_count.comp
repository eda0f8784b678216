#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// How often each digit occurs in each block of 64 x ITEMS keys. A thread counts a run of keys in counters of its own,
// two 16-bit counters to a word, so that there are neither atomics nor barriers while counting.
layout(constant_id = 0) const uint DIGIT_BITS = 6u; // bits of a digit, 1 to 7
layout(constant_id = 1) const uint ITEMS = 64u;     // keys of a thread, a multiple of 4, at most 1020
const uint PAIRS = 1u << (DIGIT_BITS - 1u);
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] keys
layout(binding = 1, scalar) readonly buffer Keys { uvec4 keys[]; };     // [count / 4, rounded up]
layout(binding = 2, scalar) writeonly buffer Counts { uint counts[]; }; // [digit, stride] keys of the block with the digit
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint stride;   // blocks that `counts` has room for
  uint shift;    // lowest bit of the digit
  uint mask;     // ones where the digit has bits
} push;
shared uint counters[PAIRS * 65u]; // a row of 64 threads per pair of digits, one more against bank conflicts
void main() {
  uint n = min(count[0], push.capacity);
  uint t = gl_LocalInvocationID.x;
  uint block = group_index();
  uint first = (block * 64u + t) * ITEMS;
  uint last = min(first + ITEMS, n), shift = push.shift, mask = push.mask;
  for (uint p = 0u; p < PAIRS; ++p) counters[p * 65u + t] = 0u;
  for (uint i = first; i < last; i += 4u) {
    uvec4 digit = (keys[i / 4u] >> shift) & mask;
    for (uint c = 0u; c < 4u; ++c) {
      if (i + c < last) counters[(digit[c] >> 1u) * 65u + t] += 1u << ((digit[c] & 1u) * 16u);
    }
  }
  barrier();
  if (t < PAIRS && block * 64u * ITEMS < n) {
    uint sums = 0u;
    for (uint i = 0u; i < 64u; ++i) sums += counters[t * 65u + i];
    counts[2u * t * push.stride + block] = sums & 0xffffu;
    counts[(2u * t + 1u) * push.stride + block] = sums >> 16u;
  }
}
