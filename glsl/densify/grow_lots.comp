#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "hash.glsl"
// Lots drawn for the free cells, where there is no room for an anchor in each.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) writeonly buffer Lots { uint lots[]; }; // [free cell]
layout(push_constant, scalar) uniform Push {
  uint cells; // free cells
  uint level; // 0 is the coarsest
  uint step;  // of the training
  uint seed;  // of the run
} push;
void main() {
  uint f = thread_index();
  // The second word: the first decided about the candidates.
  if (f < push.cells) lots[f] = pcg4d(uvec4(f, push.level, push.step, push.seed)).y;
}
