#version 460
#extension GL_EXT_scalar_block_layout : require
// Workgroup counts of up to eight dispatches, each for as many threads as a count on the device says.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };    // [1] items
layout(binding = 1, scalar) writeonly buffer Groups { uint groups[]; }; // [4 * number] x, y, z of each dispatch; items after clamping
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint added;    // and this is added
  uint limit;    // workgroups in x at most
  uint number;   // dispatches
  uvec3 shape0;  // items of a tile, threads per tile begun, threads of a workgroup
  uvec3 shape1;  // of the second dispatch, and so on
  uvec3 shape2;
  uvec3 shape3;
  uvec3 shape4;
  uvec3 shape5;
  uvec3 shape6;
  uvec3 shape7;
} push;
void main() {
  uint i = gl_LocalInvocationID.x, n = min(count[0], push.capacity) + push.added;
  if (i >= push.number) return;
  uvec3 shape = i < 4u ? i < 2u ? i == 0u ? push.shape0 : push.shape1 : i == 2u ? push.shape2 : push.shape3
                       : i < 6u ? i == 4u ? push.shape4 : push.shape5 : i == 6u ? push.shape6 : push.shape7;
  uint g = ((n + shape.x - 1u) / shape.x * shape.y + shape.z - 1u) / shape.z;
  uint rows = (g + push.limit - 1u) / push.limit;
  groups[4u * i] = min(g, push.limit);
  groups[4u * i + 1u] = rows;
  groups[4u * i + 2u] = 1u;
  groups[4u * i + 3u] = n;
}
