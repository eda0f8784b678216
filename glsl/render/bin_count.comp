#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "tiles.glsl"
// Conic of every Gaussian that exists and the number of tiles it touches.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(constant_id = 0) const float ALPHA_MIN = 0.00392156862745098; // a Gaussian touches the pixels where its alpha reaches this
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };          // [1] Gaussians that exist
layout(binding = 1, scalar) readonly buffer List { uint list[]; };            // [count] their slots
layout(binding = 2, scalar) readonly buffer Mean { vec2 mean[]; };            // [slot] px
layout(binding = 3, scalar) readonly buffer Covariance { vec3 covariance[]; }; // [slot] factored: variance of x given y, px^2; slope; variance of y, px^2
layout(binding = 4, scalar) readonly buffer Depth { float depth[]; };         // [slot] camera z; 0 where nothing is seen of it
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };     // [slot]
layout(binding = 6, scalar) writeonly buffer Conic { vec3 conic[]; };         // [slot] factored inverse: 1 / variance of x given y, px^-2; slope; 1 / variance of y, px^-2; likewise
layout(binding = 7, scalar) writeonly buffer Tiles { uint tiles[]; };         // [slot] tiles touched; listed ones only
layout(push_constant, scalar) uniform Push {
  uvec2 grid; // tiles in x and y
  uint tile;  // side of a tile, px
} push;

void main() {
  uint i = thread_index();
  if (i >= count[0]) return;
  uint s = list[i];
  vec3 c = covariance[s];
  float o = opacity[s];
  uint n = 0u;
  vec3 q = vec3(0.0);
  if (depth[s] > 0.0) {
    // Both variances are at least 0.3 and at most 2^120: so are their reciprocals normal numbers.
    q = vec3(1.0 / c.x, c.y, 1.0 / c.z);
    int tile = int(push.tile);
    ivec2 grid = ivec2(push.grid);
    vec2 m = mean[s];
    Support support = support_of(m, c, o, ALPHA_MIN, tile, grid);
    for (int row = support.row0; row <= support.row1; row++) {
      ivec2 columns = support_columns(support, m, row, tile, grid);
      n += uint(max(columns.y - columns.x + 1, 0));
    }
  }
  conic[s] = q;
  tiles[s] = n;
}
