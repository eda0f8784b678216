#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// The cells that candidates lie in, ascending, all free so far.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Keys { uvec3 keys[]; };            // [candidate]
layout(binding = 1, scalar) readonly buffer Order { uint order[]; };           // [candidate] candidates sorted by cell
layout(binding = 2, scalar) readonly buffer Heads { uint heads[]; };           // [cell] its first place in `order`
layout(binding = 3, scalar) readonly buffer CellCount { uint cell_count[]; };  // [1]
layout(binding = 4, scalar) writeonly buffer Cells { uvec3 cells[]; };         // [cell] key
layout(binding = 5, scalar) writeonly buffer Free { uint free[]; };            // [cell] 1
void main() {
  uint u = thread_index();
  if (u >= cell_count[0]) return;
  cells[u] = keys[order[heads[u]]];
  free[u] = 1u;
}
