#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "workgroup_scan.glsl"
// Exclusive prefix sum of all terms, given that of the blocks of 1024.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] terms
layout(binding = 1, scalar) readonly buffer Terms { uint terms[]; };    // [count] terms
layout(binding = 2, scalar) readonly buffer Before { uint before[]; };  // [count / 1024, rounded up] sum of the terms before each block
layout(binding = 3, scalar) writeonly buffer Prefix { uint prefix[]; }; // [count] sum of the terms before
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint block = group_index();
  uint first = block * 1024u + scan_thread() * 16u;
  uint run[16];
  uint sum = 0u;
  for (uint i = 0u; i < 16u; ++i) {
    run[i] = first + i < n ? terms[first + i] : 0u;
    sum += run[i];
  }
  uint all;
  uint start = exclusive_sum(sum, all);
  if (first >= n) return;
  start += before[block];
  for (uint i = 0u; i < 16u; ++i) {
    if (first + i < n) prefix[first + i] = start;
    start += run[i];
  }
}
