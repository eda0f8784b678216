#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// row = keep * row + add * token for the chosen anchors; an anchor is chosen once. A thread: four numbers.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Anchors { uint anchors[]; };    // [capacity] anchors of the side
layout(binding = 2, scalar) readonly buffer Added { vec4 added[]; };        // [capacity * 8] of the tokens
layout(binding = 3, scalar) buffer Feature { vec4 feature[]; };             // [N * 8] of the anchors
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens at most
  float keep;    // on the row
  float add;     // on the token
} push;
void main() {
  uint i = thread_index();
  if (i >= 8u * min(tokens[push.own], push.capacity)) return;
  uint at = 8u * anchors[i / 8u] + i % 8u;
  feature[at] = push.keep * feature[at] + push.add * added[i];
}
