// Sums over a workgroup of 64 threads in a fixed order. All threads call it; the result is thread 0's.
// Terms pass through at most 7 + 7 additions here.
shared vec4 group_terms[64];
shared vec4 group_rows[8];
vec4 group_sum(vec4 term) {
  uint t = gl_LocalInvocationID.x;
  group_terms[t] = term;
  barrier();
  if (t < 8u) {
    vec4 row = group_terms[8u * t];
    for (uint i = 1u; i < 8u; ++i) row += group_terms[8u * t + i];
    group_rows[t] = row;
  }
  barrier();
  vec4 total = vec4(0.0);
  if (t == 0u) {
    total = group_rows[0];
    for (uint i = 1u; i < 8u; ++i) total += group_rows[i];
  }
  return total;
}
