// Exclusive prefix sum over the 64 threads of a workgroup, whatever the subgroup size: eight rows of eight.
// Called from uniform control flow; may be called again in a loop.
shared uint scan_terms[64];
shared uint scan_rows[8];
uint exclusive_sum(uint term, out uint total) {
  const uint t = gl_LocalInvocationID.x;
  barrier(); // the previous call's readers are done
  scan_terms[t] = term;
  barrier();
  if (t < 8u) {
    uint row = 0u;
    for (uint i = 0u; i < 8u; ++i) row += scan_terms[t * 8u + i];
    scan_rows[t] = row;
  }
  barrier();
  uint before = 0u;
  total = 0u;
  for (uint i = 0u; i < 8u; ++i) {
    uint row = scan_rows[i];
    before += i < t / 8u ? row : 0u;
    total += row;
  }
  for (uint i = t & ~7u; i < t; ++i) before += scan_terms[i];
  return before;
}
