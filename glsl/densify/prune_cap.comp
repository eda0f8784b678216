#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// No Gaussian's scale grows beyond the cap: components 3 to 5 of an anchor's six.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) buffer LogScaling { float log_scaling[]; }; // [anchor, 6]
layout(push_constant, scalar) uniform Push {
  uint anchors; // anchors
  float cap;    // largest log-scale of a Gaussian
} push;
void main() {
  uint a = thread_index();
  if (a >= push.anchors) return;
  for (uint i = 6u * a + 3u; i < 6u * a + 6u; ++i) {
    if (log_scaling[i] > push.cap) log_scaling[i] = push.cap;
  }
}
