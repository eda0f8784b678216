#extension GL_KHR_shader_subgroup_arithmetic : require
// Exclusive prefix sum over the 64 threads of a workgroup, for any subgroup size from 4 on. Threads are numbered by
// subgroup and lane, since nothing says that lanes follow gl_LocalInvocationID.
// Called from uniform control flow; a second call needs a barrier() in between.
shared uint scan_rows[16];
uint scan_thread() { return gl_SubgroupID * gl_SubgroupSize + gl_SubgroupInvocationID; }
uint exclusive_sum(uint term, out uint total) {
  uint inclusive = subgroupInclusiveAdd(term);
  if (gl_SubgroupInvocationID == gl_SubgroupSize - 1u) scan_rows[gl_SubgroupID] = inclusive;
  barrier();
  uint before = inclusive - term;
  total = 0u;
  for (uint i = 0u; i < gl_NumSubgroups; ++i) {
    uint row = scan_rows[i];
    before += i < gl_SubgroupID ? row : 0u;
    total += row;
  }
  return before;
}
