#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Where the list of decoded Gaussians goes on to the next Gaussian of the anchors.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };           // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Listed { uint listed[]; };           // [listed_count] slots k V + v of the decoded Gaussians, ascending
layout(binding = 2, scalar) readonly buffer ListedCount { uint listed_count[]; }; // [1]
layout(binding = 3, scalar) writeonly buffer Segments { uint segments[]; };      // [K+2] where the list of each k begins; its end; visible anchors
void main() {
  uint k = thread_index(), n = groups[3], end = listed_count[0];
  if (k > OFFSETS) return;
  if (k == 0u) segments[OFFSETS + 1u] = n;
  uint first = 0u, count = end;
  while (count > 0u) {
    uint step = count / 2u;
    if (listed[first + step] < k * n) {
      first += step + 1u;
      count -= step + 1u;
    } else {
      count = step;
    }
  }
  segments[k] = first;
}
