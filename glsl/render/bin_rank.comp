#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Tile counts in depth order.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer DrawnCount { uint drawn_count[]; }; // [1]
layout(binding = 1, scalar) readonly buffer Order { uint order[]; };            // [rank] slot, nearest first
layout(binding = 2, scalar) readonly buffer Tiles { uint tiles[]; };            // [slot] tiles touched
layout(binding = 3, scalar) writeonly buffer RankTiles { uint rank_tiles[]; };  // [rank] tiles touched
void main() {
  uint r = thread_index();
  if (r < drawn_count[0]) rank_tiles[r] = tiles[order[r]];
}
