#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// Fused multiply-adds in registers: eight chains x -> a x + b that do not wait for one another, 64 steps of each in a round.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Start { float start[]; };  // [n] where the thread's chains begin
layout(binding = 1, scalar) writeonly buffer Sums { float sums[]; };   // [n] sum of the chains' ends
layout(push_constant, scalar) uniform Push {
  uint n;      // threads
  uint rounds; // of 64 steps of 8 chains
  float a;     // 0 to 1/2: the chains contract, and so do their roundings
  float b;
} push;
void main() {
  uint i = thread_index();
  if (i >= push.n) return;
  float x[8];
  [[unroll]] for (uint c = 0u; c < 8u; ++c) x[c] = start[i] + float(c);
  for (uint r = 0u; r < push.rounds; ++r) {
    [[unroll]] for (uint s = 0u; s < 64u; ++s) {
      [[unroll]] for (uint c = 0u; c < 8u; ++c) x[c] = fma(x[c], push.a, push.b);
    }
  }
  sums[i] = ((x[0] + x[1]) + (x[2] + x[3])) + ((x[4] + x[5]) + (x[6] + x[7]));
}
