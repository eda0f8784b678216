// Which tiles a Gaussian touches: those holding a pixel centre where its alpha can reach the threshold alpha_min.
//
// alpha >= alpha_min is q(d) = (dx - k dy)^2 / N + dy^2 / V <= 2 ln(opacity / alpha_min) for the factored covariance (N, k, V): an
// ellipse around the mean. Per row of tiles its extent in x is found over the row's sample band; the right boundary x(dy) is concave, so
// its maximum over a band lies at the ellipse's own extreme clamped into the band.

// The bound on q, widened by what float32 rounding of q in the rasteriser may take away, so that culling never decides
// a pixel: 1e-3 absolute, 1e-4 relative.
float support_bound(float opacity, float alpha_min) { return 2.0 * log(opacity / alpha_min) * 1.0001 + 1e-3; }

// Which bands of `rows` rows of a tile, `bands` of them from `top` on (centre of the first row, px), hold a sample at which alpha
// can reach the threshold: bit b for band b. inverse_v is the conic's 1 / V, so that |dy| <= sqrt(bound V) there. Written so that what is not a
// number keeps a band.
uint support_bands(float mean_y, float inverse_v, float bound, float top, uint rows, uint bands) {
  float reach = sqrt(max(bound, 0.0) / inverse_v);
  uint mask = 0u;
  for (uint b = 0u; b < bands; b++) {
    float first = top + float(b * rows), last = first + float(rows - 1u);
    bool beyond = first - mean_y > reach || mean_y - last > reach;
    if (!beyond) mask |= 1u << b;
  }
  return mask;
}

struct Support {
  float bound;
  vec3 covariance; // factored
  vec2 half_size;  // of the bounding box, px
  float tip;       // dy where dx is largest, px
  int row0, row1; // tile rows, inclusive
};

// Half the bounding box of {q <= bound} is sqrt(bound * covariance diagonal), with xx = N + k^2 V.
Support support_of(vec2 mean, vec3 covariance, float opacity, float alpha_min, int tile, ivec2 tiles) {
  Support s;
  s.bound = support_bound(opacity, alpha_min);
  s.covariance = covariance;
  float xy = covariance.y * covariance.z, xx = covariance.x + covariance.y * xy;
  s.half_size = sqrt(max(s.bound, 0.0) * vec2(xx, covariance.z));
  s.tip = xy / xx * s.half_size.x;
  // Tile row t holds the samples t*tile + 0.5 ... t*tile + tile - 0.5. Far-away means are clamped before the conversion
  // to int, which is undefined beyond its range.
  float low = clamp(mean.y - s.half_size.y, -1e6, 1e6), high = clamp(mean.y + s.half_size.y, -1e6, 1e6);
  s.row0 = max(int(ceil((low - float(tile) + 0.5) / float(tile))), 0);
  s.row1 = min(int(floor((high - 0.5) / float(tile))), tiles.y - 1);
  if (!(s.bound >= 0.0)) s.row1 = s.row0 - 1;
  return s;
}

// First and last tile column (inclusive, may be empty) of tile row `row`. Given dy, dx lies within
// k dy +- sqrt((bound - dy^2 / V) N): a form without differences of large products.
ivec2 support_columns(Support s, vec2 mean, int row, int tile, ivec2 tiles) {
  float low = float(row * tile) + 0.5 - mean.y, high = low + float(tile) - 1.0;
  low = clamp(low, -s.half_size.y, s.half_size.y);
  high = clamp(high, -s.half_size.y, s.half_size.y);
  float narrow = s.covariance.x, slope = s.covariance.y;
  float at_right = clamp(s.tip, low, high), at_left = clamp(-s.tip, low, high);
  float right = slope * at_right + sqrt(max(s.bound - at_right * at_right / s.covariance.z, 0.0) * narrow);
  float left = slope * at_left - sqrt(max(s.bound - at_left * at_left / s.covariance.z, 0.0) * narrow);
  // Near the tips the root's argument cancels to about 1e-7 bound: sqrt(1e-7) of the extent across. Along, the products
  // with the slope, here and in the rasteriser, are rounded: some 1e-7 of the extent in x.
  float slack = 1e-3 + 1e-3 * sqrt(max(s.bound, 0.0) * narrow) + 1e-6 * s.half_size.x;
  float x1 = clamp(mean.x + right + slack, -1e6, 1e6);
  float x0 = clamp(mean.x + left - slack, -1e6, 1e6);
  int c0 = max(int(ceil((x0 - float(tile) + 0.5) / float(tile))), 0);
  int c1 = min(int(floor((x1 - 0.5) / float(tile))), tiles.x - 1);
  return ivec2(c0, c1);
}

// Where long lists are cut: before every CUT-th place of all tiles' lists in a row. A cut inside a tile's list has a number, its place
// divided by CUT, and the state of the tile's 256 pixels there, plane by plane: colour, transmittance (-1 for a pixel that is
// finished, or beside the picture), depth. The way back begins at every one of them at once.
const uint CUT = 512u;
const uint CUT_PLANES = 5u;
uint cut_state_at(uint cut, uint plane, uint pixel) { return (cut * CUT_PLANES + plane) * 256u + pixel; }
