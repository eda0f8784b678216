// Adds the slices' sums of a block (`product.glsl`, included before) in halves: slice 0 has them all. All threads of the
// workgroup call it, once.
const uint SUMS = SLICES / 2u * SLICE_THREADS;
shared vec4 slice_sums[4u * SUMS];
void add_slices(inout vec4 sum[4]) {
  uint t = gl_LocalInvocationID.x;
  for (uint width = SLICES / 2u; width > 0u; width /= 2u) {
    uint slice = block_slice();
    barrier();
    if (slice >= width && slice < 2u * width) {
      [[unroll]] for (uint r = 0u; r < 4u; ++r) slice_sums[r * SUMS + t - width * SLICE_THREADS] = sum[r];
    }
    barrier();
    if (slice < width) {
      [[unroll]] for (uint r = 0u; r < 4u; ++r) sum[r] += slice_sums[r * SUMS + t];
    }
  }
}
