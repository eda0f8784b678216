#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "cell.glsl"
// Sort keys of the candidates' cells.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Candidates { uint candidates[]; };    // [candidate] its place among [anchor, offset]
layout(binding = 1, scalar) readonly buffer Position { vec3 position[]; };        // [anchor] world
layout(binding = 2, scalar) readonly buffer Offset { vec3 offset[]; };            // [anchor, offset]
layout(binding = 3, scalar) readonly buffer LogScaling { float log_scaling[]; };  // [anchor, 6]
layout(binding = 4, scalar) writeonly buffer Keys { uvec3 keys[]; };              // [candidate] coordinates above the lowest, packed
layout(binding = 5, scalar) writeonly buffer FirstWords { uint first_words[]; };  // [candidate] the lowest 32 bits of the key
layout(push_constant, scalar) uniform Push {
  ivec3 low;          // lowest cell
  uvec3 bits;         // of each coordinate above it
  uint found;         // candidates
  uint offsets;       // Gaussians per anchor
  float inverse_size; // 1 / side of a cell
} push;
void main() {
  uint j = thread_index();
  if (j >= push.found) return;
  uint s = candidates[j];
  uint a = s / push.offsets;
  vec3 log_scale = vec3(log_scaling[6u * a], log_scaling[6u * a + 1u], log_scaling[6u * a + 2u]);
  vec3 q = cell_coordinates(gaussian_position(position[a], offset[s], log_scale), push.inverse_size);
  uvec3 key = cell_key(uvec3(ivec3(q) - push.low), push.bits);
  keys[j] = key;
  first_words[j] = key.x;
}
