#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "group_sum.glsl"
// Row sums of partial sums: one workgroup per row.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Partial { float partial[]; }; // [rows * count] partial sums
layout(binding = 1, scalar) writeonly buffer Sums { float sums[]; };      // [first + row] their sums
layout(push_constant, scalar) uniform Push {
  uint count; // partial sums of a row
  uint rows;  // as many workgroups
  uint first; // where the rows' sums go
} push;
void main() {
  uint row = gl_WorkGroupID.x;
  if (row >= push.rows) return;
  // Four accumulators shorten the chain of roundings; the order is fixed.
  vec4 total = vec4(0.0);
  for (uint i = gl_LocalInvocationID.x; i < push.count; i += 256u) {
    uint at = row * push.count + i;
    total.x += partial[at];
    if (i + 64u < push.count) total.y += partial[at + 64u];
    if (i + 128u < push.count) total.z += partial[at + 128u];
    if (i + 192u < push.count) total.w += partial[at + 192u];
  }
  vec4 s = group_sum(total);
  if (gl_LocalInvocationID.x == 0u) sums[push.first + row] = (s.x + s.y) + (s.z + s.w);
}
