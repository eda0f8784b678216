#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// First and one-past-last pair of every tile in the sorted list. Tiles without pairs stay as they were (zero). Also in which tiles'
// lists cuts lie.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "tiles.glsl"
layout(binding = 0, scalar) readonly buffer PairCount { uint pair_count[]; };   // [1]
layout(binding = 1, scalar) readonly buffer SortedTile { uint sorted_tile[]; }; // [pair] tile, ascending
layout(binding = 2, scalar) buffer Ranges { uvec2 ranges[]; };                  // [tile + 1] first, one past last
layout(binding = 3, scalar) writeonly buffer CutTile { uint cut_tile[]; };      // [cut] one more than the tile that has pairs on both sides, or 0; of cut 0 how many follow
void main() {
  uint i = thread_index();
  uint n = pair_count[0];
  if (i >= n) return;
  uint tile = sorted_tile[i];
  if (i == 0u) cut_tile[0] = (n - 1u) / CUT;
  if (i > 0u && i % CUT == 0u) cut_tile[i / CUT] = sorted_tile[i - 1u] == tile ? tile + 1u : 0u;
  if (i == 0u || sorted_tile[i - 1u] != tile) ranges[tile].x = i;
  if (i + 1u == n || sorted_tile[i + 1u] != tile) ranges[tile].y = i + 1u;
}
