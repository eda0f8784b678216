#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// Exponentials in registers: four chains x -> exp(-x) that do not wait for one another, 16 steps of each in a round.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Start { float start[]; };  // [n] where the thread's chains begin, 0 to 1
layout(binding = 1, scalar) writeonly buffer Sums { float sums[]; };   // [n] sum of the chains' ends
layout(push_constant, scalar) uniform Push {
  uint n;      // threads
  uint rounds; // of 16 steps of 4 chains
} push;
void main() {
  uint i = thread_index();
  if (i >= push.n) return;
  float x[4];
  [[unroll]] for (uint c = 0u; c < 4u; ++c) x[c] = start[i] + 0.125 * float(c);
  for (uint r = 0u; r < push.rounds; ++r) {
    [[unroll]] for (uint s = 0u; s < 16u; ++s) {
      [[unroll]] for (uint c = 0u; c < 4u; ++c) x[c] = exp(-x[c]);
    }
  }
  sums[i] = (x[0] + x[1]) + (x[2] + x[3]);
}
