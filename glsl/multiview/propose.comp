#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// Planes to try at the sites of one colour of a checkerboard: the site's own, those of sites of the other colour, and
// random ones. Candidate k of the i-th such site is element k n + i, n = rows ceil(columns / 2), so that neighbours in a
// subgroup try planes of one origin. Where a row has no i-th site of the colour nothing is written.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "hash.glsl"
layout(binding = 0, scalar) readonly buffer Plane { vec3 plane[]; };          // [site] inverse depth 1/z at its pixel, slopes of it per pixel along x and y
layout(binding = 1, scalar) writeonly buffer Candidate { vec3 candidate[]; }; // [candidate][site of the colour] the same
layout(push_constant, scalar) uniform Push {
  uvec2 sites;    // columns, rows
  uint color;     // 0 or 1: sites with column + row of this parity
  uint reach;     // odd: distance in sites of the farther neighbours
  uint draw;      // number of this draw, for the random planes
  uint seed;      // number of the view, likewise
  float stride;   // pixels from site to site
  float farthest; // lowest inverse depth
  float nearest;  // highest inverse depth
  float spread;   // largest change of the inverse depth
  float tilt;     // slope per inverse depth of a surface at 45 degrees: 1 / focal length in pixels
} push;
const uint CANDIDATES = 12u;
const float STEEPEST = 2.0; // tangent of the steepest surface drawn
// From -1 to 1, exact.
float drawn(uint word) { return float(int(word >> 8u) - 8388608) * (1.0 / 8388608.0); }
void main() {
  uint columns = push.sites.x, per_row = (columns + 1u) / 2u, n = per_row * push.sites.y, t = thread_index();
  if (t >= n * CANDIDATES) return;
  uint k = t / n, i = t - k * n;
  uint y = i / per_row, x = 2u * (i - y * per_row) + ((y + push.color) & 1u);
  if (x >= columns) return;
  vec3 own = plane[y * columns + x];
  precise vec3 found = own;
  if (k >= 1u && k <= 8u) {
    int far = k > 4u ? int(push.reach) : 1;
    uint side = (k - 1u) & 3u;
    ivec2 step = ivec2(side == 0u ? far : side == 1u ? -far : 0, side == 2u ? far : side == 3u ? -far : 0);
    ivec2 from = ivec2(x, y) + step;
    if (from.x >= 0 && from.y >= 0 && from.x < int(columns) && from.y < int(push.sites.y)) {
      vec3 other = plane[uint(from.y) * columns + uint(from.x)];
      precise float dx = float(-step.x) * push.stride, dy = float(-step.y) * push.stride;
      found = vec3(other.x + (other.y * dx + other.z * dy), other.y, other.z);
    }
  } else if (k > 8u) {
    uvec4 words = pcg4d(uvec4(y * columns + x, k, push.draw, push.seed));
    float a = drawn(words.x), b = drawn(words.y), c = drawn(words.z);
    if (k == 9u) {
      precise float steep = push.tilt * own.x;
      found = vec3(own.x + push.spread * a, own.y + 0.5 * (steep * b), own.z + 0.5 * (steep * c));
    } else {
      precise float inverse = k == 10u ? own.x : push.farthest + (push.nearest - push.farthest) * (0.5 + 0.5 * a);
      precise float steep = STEEPEST * (push.tilt * inverse);
      found = vec3(inverse, steep * b, steep * c);
    }
  }
  found.x = min(max(found.x, push.farthest), push.nearest);
  candidate[t] = found;
}
