// Sums of one vec4 over chunks, `partial[chunk][vec4]`, by LANES threads each: thread l sums runs l, l + LANES, ... of 32 chunks,
// and the first adds the runs in their order, so that the sum is the same for any number of threads. A workgroup of 64 has
// 64 / LANES vec4s side by side, and all of its threads come here.
const uint SUM_WIDTH = 64u / LANES;
uint sum_column() { return gl_LocalInvocationID.x % SUM_WIDTH; }
uint sum_lane() { return gl_LocalInvocationID.x / SUM_WIDTH; }
shared vec4 s_runs[64];
vec4 chunk_sum(uint first, uint chunks, uint stride, uint at) {
  uint t = gl_LocalInvocationID.x;
  vec4 total = vec4(0.0);
  for (uint round = 0u; round < chunks; round += 32u * LANES) {
    uint begin = round + 32u * sum_lane();
    vec4 run = vec4(0.0);
    for (uint c = begin; c < min(begin + 32u, chunks); ++c) run += partial[(first + c) * stride + at];
    if (LANES == 1u) {
      total += run;
    } else {
      s_runs[t] = run;
      barrier();
      if (t < SUM_WIDTH) {
        for (uint l = 0u; l < LANES; ++l) total += s_runs[l * SUM_WIDTH + t];
      }
      barrier();
    }
  }
  return total;
}
