#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Puts every pair into its tile's list: the runs of `bin_tally` one behind the other, each in its pairs' order.
layout(local_size_x = 8) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer PairCount { uint pair_count[]; }; // [1] pairs
layout(binding = 1, scalar) readonly buffer PairTile { uint pair_tile[]; };   // [pair] tile
layout(binding = 2, scalar) buffer RunFirst { uint run_first[]; };            // [tile + 1, run] place of the run's next pair in the tile
layout(binding = 3, scalar) writeonly buffer Sorted { uint sorted[]; };       // [pair] pair numbers by tile, nearest first
layout(push_constant, scalar) uniform Push {
  uint runs;
} push;
void main() {
  uint run = thread_index(), n = pair_count[0], runs = push.runs;
  if (run >= runs) return;
  uint length = (n + runs - 1u) / runs, end = min(run * length + length, n);
  for (uint p = run * length; p < end; p++) {
    uint at = pair_tile[p] * runs + run;
    uint place = run_first[at];
    run_first[at] = place + 1u;
    sorted[place] = p;
  }
}
