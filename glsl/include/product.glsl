// A block of a matrix product, rows by columns, in a workgroup: both operands pass through shared memory in runs of 8 terms,
// and a thread sums 4 x 4 of the block in registers. Before including it a kernel defines ROWS and COLUMNS, multiples of 4,
// and SLICES where several threads share the terms of one element; it has SLICES * ROWS / 4 * COLUMNS / 4 threads.
//
// A term passes through at most 8 additions within its run, one for each run behind it and one for each halving of the
// slices: of n terms a depth of 8 + n / (8 SLICES) + log2 SLICES.
#ifndef SLICES
#define SLICES 1u
#endif
const uint RUN = 8u; // terms
const uint ACROSS = COLUMNS / 4u;
const uint SLICE_THREADS = ROWS / 4u * ACROSS;
// One vec4 more than a row has, so that rows do not meet in one bank.
const uint LEFT_STRIDE = ROWS / 4u + 1u, RIGHT_STRIDE = ACROSS + 1u;
const uint LEFT_SIZE = RUN * LEFT_STRIDE, RIGHT_SIZE = RUN * RIGHT_STRIDE;
shared vec4 block_left[SLICES * LEFT_SIZE];   // by term, then by row
shared vec4 block_right[SLICES * RIGHT_SIZE]; // by term, then by column

uint block_slice() { return gl_LocalInvocationID.x / SLICE_THREADS; }
uint slice_thread() { return gl_LocalInvocationID.x % SLICE_THREADS; }
// This thread's rows and columns are the four from 4 times these on.
uint block_row() { return slice_thread() / ACROSS; }
uint block_column() { return slice_thread() % ACROSS; }

// `i` takes its share of `count` for this thread of a slice.
#define EACH(i, count) for (uint i = slice_thread(); i < (count); i += SLICE_THREADS)

// Four terms of one row or column, from the quad-th four of the run on.
void put_left(uint row, uint quad, vec4 x) {
  uint at = block_slice() * LEFT_SIZE + 4u * quad * LEFT_STRIDE + row / 4u;
  [[unroll]] for (uint c = 0u; c < 4u; ++c) block_left[at + c * LEFT_STRIDE][row % 4u] = x[c];
}
void put_right(uint column, uint quad, vec4 x) {
  uint at = block_slice() * RIGHT_SIZE + 4u * quad * RIGHT_STRIDE + column / 4u;
  [[unroll]] for (uint c = 0u; c < 4u; ++c) block_right[at + c * RIGHT_STRIDE][column % 4u] = x[c];
}
// One term of four rows or columns.
void put_left_across(uint term, uint row4, vec4 x) { block_left[block_slice() * LEFT_SIZE + term * LEFT_STRIDE + row4] = x; }
void put_right_across(uint term, uint column4, vec4 x) {
  block_right[block_slice() * RIGHT_SIZE + term * RIGHT_STRIDE + column4] = x;
}

// Puts a run of terms of both operands; the kernel's.
void put(uint run);

// Adds the product of so many runs. All threads of the workgroup call it with the same number.
void add_product(uint runs, inout vec4 sum[4]) {
  uint left = block_slice() * LEFT_SIZE + block_row(), right = block_slice() * RIGHT_SIZE + block_column();
  for (uint run = 0u; run < runs; ++run) {
    barrier(); // the run before has been read
    put(run);
    barrier();
    vec4 part[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
    [[unroll]] for (uint k = 0u; k < RUN; ++k) {
      vec4 a = block_left[left + k * LEFT_STRIDE], b = block_right[right + k * RIGHT_STRIDE];
      [[unroll]] for (uint r = 0u; r < 4u; ++r) part[r] = fma(vec4(a[r]), b, part[r]);
    }
    [[unroll]] for (uint r = 0u; r < 4u; ++r) sum[r] += part[r];
  }
}
