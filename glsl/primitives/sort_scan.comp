#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "thread.glsl"
// For each digit: keys with it in the blocks before each block, and altogether. One subgroup per digit: blocks are few.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] keys
layout(binding = 1, scalar) buffer Counts { uint counts[]; };           // [digit, stride] in: keys of the block; out: of the blocks before
layout(binding = 2, scalar) writeonly buffer Totals { uint totals[]; }; // [digit] keys with the digit
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint stride;   // blocks that `counts` has room for
  uint block;    // keys of a block
  uint digits;   // digits
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint blocks = n / push.block + uint(n % push.block != 0u);
  uint digit = group_index() * gl_NumSubgroups + gl_SubgroupID;
  if (digit >= push.digits) return;
  uint carry = 0u;
  for (uint start = 0u; start < blocks; start += gl_SubgroupSize) {
    uint block = start + gl_SubgroupInvocationID;
    uint at = digit * push.stride + block;
    uint own = block < blocks ? counts[at] : 0u;
    uint before = carry + subgroupExclusiveAdd(own);
    if (block < blocks) counts[at] = before;
    carry += subgroupAdd(own);
  }
  if (gl_SubgroupInvocationID == 0u) totals[digit] = carry;
}
