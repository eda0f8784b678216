#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// First and one-past-last pair of every tile, from where its first run begins.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer PairCount { uint pair_count[]; }; // [1] pairs
layout(binding = 1, scalar) readonly buffer RunFirst { uint run_first[]; };   // [tile + 1, run] place of the run's first pair in the tile
layout(binding = 2, scalar) writeonly buffer Ranges { uvec2 ranges[]; };      // [tile + 1] first, one past last
layout(push_constant, scalar) uniform Push {
  uint tiles; // with the one behind the last
  uint runs;
} push;
void main() {
  uint tile = thread_index();
  if (tile >= push.tiles) return;
  uint next = tile + 1u;
  ranges[tile] = uvec2(run_first[tile * push.runs], next < push.tiles ? run_first[next * push.runs] : pair_count[0]);
}
