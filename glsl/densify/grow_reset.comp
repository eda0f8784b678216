#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// What was seen often enough to be judged is counted afresh; the rest goes on counting.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) buffer Gradient { float gradient[]; }; // [anchor, offset] sum of gradient norms
layout(binding = 1, scalar) buffer Seen { uint seen[]; };          // [anchor, offset] steps in which it was drawn
layout(push_constant, scalar) uniform Push {
  uint slots;    // anchors times offsets
  uint min_seen; // judged if drawn more often
} push;
void main() {
  uint s = thread_index();
  if (s >= push.slots || seen[s] <= push.min_seen) return;
  gradient[s] = 0.0;
  seen[s] = 0u;
}
