#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Anchors worth keeping; what was in view often enough to be judged is counted afresh.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) buffer OpacitySum { float opacity_sum[]; }; // [anchor] sum of the positive opacities
layout(binding = 1, scalar) buffer Visits { uint visits[]; };           // [anchor] steps in which it was in view
layout(binding = 2, scalar) writeonly buffer Keep { uint keep[]; };     // [anchor] 0: pruned
layout(push_constant, scalar) uniform Push {
  uint anchors;      // anchors
  uint min_visits;   // judged if in view more often
  float min_opacity; // mean opacity below which an anchor goes
} push;
void main() {
  uint a = thread_index();
  if (a >= push.anchors) return;
  uint n = visits[a];
  bool kept = true;
  if (n > push.min_visits) {
    precise float least = push.min_opacity * float(n);
    kept = !(opacity_sum[a] < least);
    opacity_sum[a] = 0.0;
    visits[a] = 0u;
  }
  keep[a] = uint(kept);
}
