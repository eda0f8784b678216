#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "workgroup_scan.glsl"
// Indices of the non-zero flags in ascending order, given how many there are before each block of 1024.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };       // [1] flags
layout(binding = 1, scalar) readonly buffer Flags { uint flags[]; };       // [count] 0: left out
layout(binding = 2, scalar) readonly buffer Before { uint before[]; };     // [count / 1024, rounded up] flags set before each block
layout(binding = 3, scalar) writeonly buffer Indices { uint indices[]; };  // [flags set] where they are
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint block = group_index();
  uint first = block * 1024u + scan_thread() * 16u;
  uint set = 0u;
  for (uint i = 0u; i < 16u; ++i) {
    if (first + i < n && flags[first + i] != 0u) set |= 1u << i;
  }
  uint all;
  uint at = exclusive_sum(bitCount(set), all);
  if (set == 0u) return;
  at += before[block];
  for (uint i = 0u; i < 16u; ++i) {
    if ((set & (1u << i)) != 0u) indices[at++] = first + i;
  }
}
