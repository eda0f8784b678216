#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "workgroup_scan.glsl"
// For each digit: keys with it in the blocks before each block, and altogether. One workgroup per digit.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] keys
layout(binding = 1, scalar) buffer Counts { uint counts[]; };           // [digit, stride] in: keys of the block; out: of the blocks before
layout(binding = 2, scalar) writeonly buffer Totals { uint totals[]; }; // [digit] keys with the digit
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint stride;   // blocks that `counts` has room for
  uint block;    // keys of a block
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint blocks = n / push.block + uint(n % push.block != 0u);
  uint digit = group_index();
  uint carry = 0u;
  for (uint start = 0u; start < blocks; start += 512u) {
    uint first = start + gl_LocalInvocationID.x * 8u;
    uint row = digit * push.stride + first;
    uint run[8];
    uint sum = 0u;
    for (uint i = 0u; i < 8u; ++i) {
      run[i] = first + i < blocks ? counts[row + i] : 0u;
      sum += run[i];
    }
    uint all;
    uint before = carry + exclusive_sum(sum, all);
    for (uint i = 0u; i < 8u; ++i) {
      if (first + i < blocks) counts[row + i] = before;
      before += run[i];
    }
    carry += all;
  }
  if (gl_LocalInvocationID.x == 0u) totals[digit] = carry;
}
