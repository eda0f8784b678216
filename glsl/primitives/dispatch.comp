#version 460
#extension GL_EXT_scalar_block_layout : require
// Workgroup counts for as many threads as a count on the device says.
layout(local_size_x = 1) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] items
layout(binding = 1, scalar) writeonly buffer Groups { uint groups[]; }; // [4] x, y, z of the dispatch; items after clamping
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint tile;     // items of a tile
  uint factor;   // threads per tile begun
  uint group;    // threads of a workgroup
  uint limit;    // workgroups in x at most
} push;
void main() {
  uint n = min(count[0], push.capacity);
  uint g = ((n + push.tile - 1u) / push.tile * push.factor + push.group - 1u) / push.group;
  uint rows = (g + push.limit - 1u) / push.limit;
  groups[0] = min(g, push.limit);
  groups[1] = rows;
  groups[2] = 1u;
  groups[3] = n;
}
