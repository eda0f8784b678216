#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "cell.glsl"
#include "hash.glsl"
// Gaussians that ask for an anchor at one level, and the box of cells around them.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Gradient { float gradient[]; };       // [anchor, offset] sum of gradient norms, per half picture
layout(binding = 1, scalar) readonly buffer Seen { uint seen[]; };                // [anchor, offset] steps in which it was drawn
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };        // [anchor] world
layout(binding = 3, scalar) readonly buffer Offset { vec3 offset[]; };            // [anchor, offset]
layout(binding = 4, scalar) readonly buffer LogScaling { float log_scaling[]; };  // [anchor, 6]
layout(binding = 5, scalar) writeonly buffer Flags { uint flags[]; };             // [anchor, offset] 1: a candidate
layout(binding = 6, scalar) buffer Bounds { int bounds[]; };                      // [7] lowest cell x, y, z; highest; Gaussians beyond the grid
layout(push_constant, scalar) uniform Push {
  uint slots;         // anchors times offsets
  uint offsets;       // Gaussians per anchor
  float threshold;    // mean gradient from which a Gaussian is a candidate, per half picture
  uint min_seen;      // it must have been drawn more often
  uint level;         // 0 is the coarsest; a candidate is kept with probability 1 - 0.5^(level + 1)
  uint step;          // of the training
  uint seed;          // of the run
  float inverse_size; // 1 / side of a cell
} push;
void main() {
  uint s = thread_index();
  if (s >= push.slots) return;
  bool found = false;
  uint n = seen[s];
  precise float least = push.threshold * float(n);
  if (n > push.min_seen && gradient[s] >= least) {
    // Dropped where the first level + 1 bits of the hash are all 0.
    uint hash = pcg4d(uvec4(s, push.level, push.step, push.seed)).x;
    if ((hash >> (31u - push.level)) != 0u) {
      uint a = s / push.offsets;
      vec3 log_scale = vec3(log_scaling[6u * a], log_scaling[6u * a + 1u], log_scaling[6u * a + 2u]);
      vec3 q = cell_coordinates(gaussian_position(position[a], offset[s], log_scale), push.inverse_size);
      found = cell_exists(q);
      if (found) {
        ivec3 low = subgroupMin(ivec3(q)), high = subgroupMax(ivec3(q));
        if (subgroupElect()) {
          // Smallest and largest do not depend on the order.
          for (uint i = 0u; i < 3u; ++i) {
            atomicMin(bounds[i], low[i]);
            atomicMax(bounds[3u + i], high[i]);
          }
        }
      } else {
        atomicAdd(bounds[6], 1);
      }
    }
  }
  flags[s] = uint(found);
}
