#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "workgroup_scan.glsl"
// Exclusive prefix sum by one workgroup: of a few terms, or of the sums of blocks.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] items
layout(binding = 1, scalar) readonly buffer Terms { uint terms[]; };    // [count / items, rounded up] terms
layout(binding = 2, scalar) writeonly buffer Prefix { uint prefix[]; }; // [count / items, rounded up] sum of the terms before
layout(binding = 3, scalar) writeonly buffer Total { uint total[]; };   // [1] sum of all terms, 2^32 - 1 if it is more
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint items;    // items per term
} push;
// 1 once a sum does not fit: terms are not negative, so a sum that is less than the one before it has wrapped.
shared uint wrapped;
void main() {
  if (scan_thread() == 0u) wrapped = 0u;
  barrier();
  uint clamped = min(count[0], push.capacity);
  uint n = clamped / push.items + uint(clamped % push.items != 0u);
  uint carry = 0u;
  for (uint start = 0u; start < n; start += 1024u) {
    uint first = start + scan_thread() * 16u;
    uint run[16];
    uint sum = 0u;
    for (uint i = 0u; i < 16u; ++i) {
      run[i] = first + i < n ? terms[first + i] : 0u;
      sum += run[i];
    }
    uint all;
    uint before = carry + exclusive_sum(sum, all);
    for (uint i = 0u; i < 16u; ++i) {
      if (first + i < n) prefix[first + i] = before;
      uint after = before + run[i];
      if (after < before) atomicOr(wrapped, 1u);
      before = after;
    }
    carry += all;
    barrier(); // all have read the sums of this round
  }
  barrier();
  if (scan_thread() == 0u) total[0] = wrapped == 0u ? carry : 0xffffffffu;
}
