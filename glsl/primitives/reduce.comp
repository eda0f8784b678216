#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// Sums of blocks of 1024 rows, each component by itself, always in the same tree: a thread adds every 64th row (16 of
// them), then the 64 threads' sums are added as eight rows of eight.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };      // [1] items
layout(binding = 1, scalar) readonly buffer Values { float values[]; };   // [count / items, rounded up, components]
layout(binding = 2, scalar) writeonly buffer Sums { float sums[]; };      // [blocks, components]
layout(push_constant, scalar) uniform Push {
  uint capacity;   // the count is clamped to this
  uint items;      // items per row of `values`
  uint components; // components of a row
} push;
shared float terms[64];
void main() {
  uint clamped = min(count[0], push.capacity);
  uint n = clamped / push.items + uint(clamped % push.items != 0u);
  uint t = gl_LocalInvocationID.x;
  uint block = group_index();
  // Block 0 is written even when there is nothing: the sum of nothing is 0.
  if (block > 0u && block * 1024u >= n) return;
  for (uint c = 0u; c < push.components; ++c) {
    float sum = 0.0;
    for (uint i = 0u; i < 16u; ++i) {
      uint row = block * 1024u + i * 64u + t;
      if (row < n) sum += values[row * push.components + c];
    }
    terms[t] = sum;
    barrier();
    if (t < 8u) {
      sum = 0.0;
      for (uint i = 0u; i < 8u; ++i) sum += terms[t * 8u + i];
      terms[t * 8u] = sum; // read by no other thread before the barrier
    }
    barrier();
    if (t == 0u) {
      for (uint i = 1u; i < 8u; ++i) sum += terms[i * 8u];
      sums[block * push.components + c] = sum;
    }
    barrier();
  }
}
