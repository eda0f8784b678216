#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "cell.glsl"
#include "model.glsl"
// A new anchor in every free cell: a thread per component of its feature.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer FreeCells { uint free_cells[]; };     // [new anchor] its cell
layout(binding = 1, scalar) readonly buffer Cells { uvec3 cells[]; };             // [cell] key
layout(binding = 2, scalar) readonly buffer CellCount { uint cell_count[]; };     // [1]
layout(binding = 3, scalar) readonly buffer Heads { uint heads[]; };              // [cell] its first place in `order`
layout(binding = 4, scalar) readonly buffer Order { uint order[]; };              // [candidate] candidates sorted by cell
layout(binding = 5, scalar) readonly buffer Candidates { uint candidates[]; };    // [candidate] its place among [anchor, offset]
layout(binding = 6, scalar) writeonly buffer Position { vec3 position[]; };       // [anchor] world
layout(binding = 7, scalar) buffer Feature { float feature[]; };                  // [anchor, 32] of the new ones: the largest of the cell's candidates
layout(binding = 8, scalar) writeonly buffer LogScaling { float log_scaling[]; }; // [anchor, 6]
layout(push_constant, scalar) uniform Push {
  ivec3 low;      // lowest cell of a candidate
  uvec3 bits;     // of each coordinate above it
  uint found;     // candidates
  uint offsets;   // Gaussians per anchor
  uint anchors;   // anchors so far
  uint added;     // new anchors
  float size;     // side of a cell
  float log_size; // its logarithm
} push;
void main() {
  uint f = thread_index() / FEATURE;
  uint c = thread_index() % FEATURE;
  if (f >= push.added) return;
  uint u = free_cells[f];
  uint last = u + 1u < cell_count[0] ? heads[u + 1u] : push.found;
  uint r = heads[u];
  float largest = feature[candidates[order[r]] / push.offsets * FEATURE + c];
  for (++r; r < last; ++r) largest = max(largest, feature[candidates[order[r]] / push.offsets * FEATURE + c]);
  uint a = push.anchors + f;
  feature[a * FEATURE + c] = largest;
  if (c < 6u) log_scaling[6u * a + c] = push.log_size;
  if (c == 0u) {
    ivec3 cell = push.low + ivec3(cell_above(cells[u], push.bits));
    position[a] = vec3(cell) * push.size;
  }
}
