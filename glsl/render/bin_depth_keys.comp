#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Sort keys by depth. Depths are positive, so their bits order as they do, and so does their bits' distance from the
// near plane's. Equal keys keep the slots' order.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer DrawnCount { uint drawn_count[]; }; // [1] Gaussians that touch a tile
layout(binding = 1, scalar) readonly buffer Drawn { uint drawn[]; };            // [drawn] their slots, ascending
layout(binding = 2, scalar) readonly buffer Depth { float depth[]; };           // [slot] camera z
layout(binding = 3, scalar) writeonly buffer Keys { uint keys[]; };             // [drawn] bits of the depth
layout(binding = 4, scalar) writeonly buffer Values { uint values[]; };         // [drawn] slot
layout(push_constant, scalar) uniform Push {
  uint base; // bits of the near plane
  uint last; // largest key
} push;
void main() {
  uint i = thread_index();
  if (i >= drawn_count[0]) return;
  uint s = drawn[i];
  uint bits = floatBitsToUint(depth[s]);
  keys[i] = min(max(bits, push.base) - push.base, push.last);
  values[i] = s;
}
