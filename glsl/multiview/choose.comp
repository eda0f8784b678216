#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Of the planes tried at each site of one colour the one of the lowest score, the first of several.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Candidate { vec3 candidate[]; }; // [candidate][site of the colour] as `propose` has it
layout(binding = 1, scalar) readonly buffer Score { float score[]; };        // [candidate][site of the colour] as `score` has it
layout(binding = 2, scalar) buffer Plane { vec3 plane[]; };                  // [site] those of the other colour stay
layout(binding = 3, scalar) buffer Cost { float cost[]; };                   // [site] the score of the plane
layout(push_constant, scalar) uniform Push {
  uvec2 sites; // columns, rows
  uint color;  // as in `propose`
} push;
const uint CANDIDATES = 12u;
void main() {
  uint columns = push.sites.x, per_row = (columns + 1u) / 2u, n = per_row * push.sites.y, i = thread_index();
  if (i >= n) return;
  uint y = i / per_row, x = 2u * (i - y * per_row) + ((y + push.color) & 1u);
  if (x >= columns) return;
  uint best = 0u;
  float lowest = score[i];
  for (uint k = 1u; k < CANDIDATES; k++) {
    float here = score[k * n + i];
    if (here < lowest) {
      lowest = here;
      best = k;
    }
  }
  plane[y * columns + x] = candidate[best * n + i];
  cost[y * columns + x] = lowest;
}
