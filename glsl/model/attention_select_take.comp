#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// The first tokens of each side from the sorted candidates, as many of one as of the other. A thread: one of each.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Candidates { uint candidates[]; }; // [2] inside, around
layout(binding = 1, scalar) readonly buffer Sorted { uint sorted_anchors[]; };  // [V] anchors by key: inside, around, others
layout(binding = 2, scalar) writeonly buffer Tokens { uint tokens[]; };        // [2] tokens inside, around
layout(binding = 3, scalar) writeonly buffer Inside { uint inside[]; };        // [capacity] anchors inside the mask
layout(binding = 4, scalar) writeonly buffer Around { uint around[]; };        // [capacity] anchors around it
layout(push_constant, scalar) uniform Push {
  uint capacity; // tokens of a side at most
  uint too_few;  // with so many candidates on a side, or fewer, there are no tokens
} push;
void main() {
  uint i = thread_index();
  uint fewer = min(candidates[0], candidates[1]);
  uint n = fewer > push.too_few ? min(fewer, push.capacity) : 0u;
  if (i == 0u) {
    tokens[0] = n;
    tokens[1] = n;
  }
  if (i >= n) return;
  inside[i] = sorted_anchors[i];
  around[i] = sorted_anchors[candidates[0] + i];
}
