#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "tiles.glsl"
// One (Gaussian, tile) pair per tile touched, Gaussian after Gaussian in depth order: pairs put by tile, in this order
// within a tile, then leave every tile's list in depth order. The pairs of a Gaussian that touches more than LONG tiles are
// written by its whole subgroup, a row of tiles a thread: a thread alone would be at it long after all others.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(constant_id = 0) const float ALPHA_MIN = 0.00392156862745098; // a Gaussian touches the pixels where its alpha reaches this
layout(constant_id = 1) const uint LONG = 32u; // tiles; 2^32 - 1: a thread always writes its own
layout(binding = 0, scalar) readonly buffer DrawnCount { uint drawn_count[]; }; // [1]
layout(binding = 1, scalar) readonly buffer PairCount { uint pair_count[]; };   // [1] pairs; 0 when they do not fit
layout(binding = 2, scalar) readonly buffer Order { uint order[]; };            // [rank] slot, nearest first
layout(binding = 3, scalar) readonly buffer RankFirst { uint rank_first[]; };   // [rank] first pair
layout(binding = 4, scalar) readonly buffer Tiles { uint tiles[]; };            // [slot] tiles touched
layout(binding = 5, scalar) readonly buffer Mean { vec2 mean[]; };              // [slot] px
layout(binding = 6, scalar) readonly buffer Covariance { vec3 covariance[]; };  // [slot] factored, px^2
layout(binding = 7, scalar) readonly buffer Opacity { float opacity[]; };       // [slot]
layout(binding = 8, scalar) writeonly buffer FirstPair { uint first_pair[]; };  // [slot] first pair of a Gaussian
layout(binding = 9, scalar) writeonly buffer PairTile { uint pair_tile[]; };   // [pair] tile, row-major
layout(binding = 10, scalar) writeonly buffer PairSlot { uint pair_slot[]; };   // [pair] slot of its Gaussian
layout(push_constant, scalar) uniform Push {
  uvec2 grid; // tiles in x and y
  uint tile;  // side of a tile, px
} push;

// Writes the subgroup's long runs; all of its lanes come here. `slot`, `first` and `n` are of this lane's own run.
void expand_long(uint slot, uint first, uint n) {
  int tile = int(push.tile);
  ivec2 grid = ivec2(push.grid);
  int lane = int(gl_SubgroupInvocationID), lanes = int(gl_SubgroupSize);
  bool waits = n > LONG;
  for (;;) {
    int next = subgroupMin(waits ? lane : lanes);
    if (next == lanes) break;
    bool own = lane == next;
    waits = waits && !own;
    uint s = subgroupAdd(own ? slot : 0u), p = subgroupAdd(own ? first : 0u), end = p + subgroupAdd(own ? n : 0u);
    vec2 m = mean[s];
    Support support = support_of(m, covariance[s], opacity[s], ALPHA_MIN, tile, grid);
    for (int top = support.row0; top <= support.row1; top += lanes) {
      int row = top + lane;
      ivec2 columns = support_columns(support, m, min(row, support.row1), tile, grid);
      uint count = row > support.row1 ? 0u : uint(max(columns.y - columns.x + 1, 0));
      uint at = p + subgroupExclusiveAdd(count);
      for (uint i = 0u; i < count && at + i < end; ++i) {
        pair_tile[at + i] = uint(row * grid.x + columns.x) + i;
        pair_slot[at + i] = s;
      }
      p += subgroupAdd(count);
    }
    for (p += uint(lane); p < end; p += uint(lanes)) {
      pair_tile[p] = uint(grid.x * grid.y);
      pair_slot[p] = s;
    }
  }
}

void main() {
  uint r = thread_index();
  bool some = r < drawn_count[0] && pair_count[0] != 0u;
  if (LONG == ~0u && !some) return;
  uint s = some ? order[r] : 0u;
  uint p = some ? rank_first[r] : 0u;
  uint n = some ? tiles[s] : 0u;
  if (some) first_pair[s] = p;
  if (LONG != ~0u) expand_long(s, p, n);
  if (!some || n > LONG) return;
  uint end = p + n;
  // CPU drivers load what is read in a loop again for every lane: not the push constants, not the mean.
  int tile = int(push.tile);
  ivec2 grid = ivec2(push.grid);
  vec2 m = mean[s];
  Support support = support_of(m, covariance[s], opacity[s], ALPHA_MIN, tile, grid);
  // One loop for rows and columns, tested at its end: CPU drivers repeat an inner loop for the widest row of eight
  // Gaussians, and run every loop's body once more, masked, when the test at its head fails.
  int row = support.row0;
  ivec2 columns = support_columns(support, m, row, tile, grid);
  do {
    // Counting and this pass are two kernels; should a driver round them differently, a pair too many is dropped and one
    // too few goes to the tile behind the last, which nobody draws and whose gradients are 0.
    if (row > support.row1) columns = ivec2(grid.x * (grid.y - row));
    if (columns.x <= columns.y) {
      pair_tile[p] = uint(row * grid.x + columns.x);
      pair_slot[p] = s;
      p++;
    }
    columns.x++;
    if (columns.x > columns.y) {
      row++;
      columns = support_columns(support, m, row, tile, grid);
    }
  } while (p < end);
}
