#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// How many pairs of each run have each tile. A run is a stretch of the pairs and has one thread with counters of its
// own, so that nothing is added atomically: for CPUs, where few threads run at once and a pair is looked at twice
// instead of ten times in a sort.
layout(local_size_x = 8) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer PairCount { uint pair_count[]; }; // [1] pairs
layout(binding = 1, scalar) readonly buffer PairTile { uint pair_tile[]; };   // [pair] tile
layout(binding = 2, scalar) buffer RunPairs { uint run_pairs[]; };            // [tile + 1, run] pairs of the run in the tile, 0 before
layout(push_constant, scalar) uniform Push {
  uint runs;
} push;
void main() {
  uint run = thread_index(), n = pair_count[0], runs = push.runs;
  if (run >= runs) return;
  uint length = (n + runs - 1u) / runs, end = min(run * length + length, n);
  for (uint p = run * length; p < end; p++) run_pairs[pair_tile[p] * runs + run] += 1u;
}
