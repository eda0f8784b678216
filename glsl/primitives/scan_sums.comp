#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "workgroup_scan.glsl"
// Sums of blocks of 1024 terms.
// variant nonzero: NONZERO
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; }; // [1] terms
layout(binding = 1, scalar) readonly buffer Terms { uint terms[]; }; // [count] what is summed; in the variant `nonzero` counted where it is not 0
layout(binding = 2, scalar) writeonly buffer Sums { uint sums[]; };  // [count / 1024, rounded up] sum of each block
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint block = group_index();
  uint sum = 0u;
  for (uint i = 0u; i < 16u; ++i) {
    uint at = block * 1024u + i * 64u + scan_thread();
    if (at < n) {
#ifdef NONZERO
      sum += uint(terms[at] != 0u);
#else
      sum += terms[at];
#endif
    }
  }
  uint total;
  exclusive_sum(sum, total);
  if (scan_thread() == 0u && block * 1024u < n) sums[block] = total;
}
