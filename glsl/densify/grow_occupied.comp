#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "cell.glsl"
// Cells that have an anchor are not free.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Position { vec3 position[]; };     // [anchor] world
layout(binding = 1, scalar) readonly buffer Cells { uvec3 cells[]; };          // [cell] key, ascending
layout(binding = 2, scalar) readonly buffer CellCount { uint cell_count[]; };  // [1]
layout(binding = 3, scalar) buffer Free { uint free[]; };                      // [cell] 0: occupied
layout(push_constant, scalar) uniform Push {
  ivec3 low;          // lowest cell of a candidate
  ivec3 high;         // highest
  uvec3 bits;         // of each coordinate above the lowest
  uint anchors;       // anchors
  float inverse_size; // 1 / side of a cell
} push;
bool before(uvec3 a, uvec3 b) {
  if (a.z != b.z) return a.z < b.z;
  if (a.y != b.y) return a.y < b.y;
  return a.x < b.x;
}
void main() {
  uint a = thread_index();
  if (a >= push.anchors) return;
  vec3 q = cell_coordinates(position[a], push.inverse_size);
  if (!cell_exists(q)) return;
  ivec3 cell = ivec3(q);
  if (any(lessThan(cell, push.low)) || any(greaterThan(cell, push.high))) return;
  uvec3 key = cell_key(uvec3(cell - push.low), push.bits);
  uint first = 0u, last = cell_count[0];
  while (first < last) {
    uint middle = first + (last - first) / 2u;
    if (before(cells[middle], key)) first = middle + 1u;
    else last = middle;
  }
  if (first < cell_count[0] && cells[first] == key) atomicAnd(free[first], 0u); // several anchors may share a cell
}
