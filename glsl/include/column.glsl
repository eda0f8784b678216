// Samples of the narrow rasteriser: tiles of 8 x 8 pixels, a thread per column, a Gaussian per lane.
//
// -log2 of a sample's exponential is a^2 + b^2 with a = (dx - k dy) / sqrt(2 ln 2 N) and b = dy / sqrt(2 ln 2 V): two squares, so that
// it is never negative and overflows to infinity, never to not-a-number. b^2 is common to a row: the lane that holds
// the Gaussian finds it for the eight rows. Down a column a falls by the same step k / sqrt(2 ln 2 N) from row to row: it is
// followed from the middle row outwards, at most four steps. The step is at most 2 (k^2 V <= x's variance, and low-pass
// bounds the other conditional variance from below by 0.3), so that each adds less than 2^-24 (|a| + 8) of rounding; for a
// needle, what counts is the rounding of k dy, once, relative to the tile: 2^-23 r at a distance of r px along it.
// Both passes must decide alike about every sample: they do it here.

const float HALF_LOG2E = 0.721347520444482; // 1 / (2 ln 2)
const uint MIDDLE = 4u; // the row that a is followed from

struct Splat {
  float axis;     // x of the ellipse's axis in the middle row, from the centres of the tile's first column, px
  float scale;    // 1 / sqrt(2 ln 2 N), 1/px
  float slope;    // k / sqrt(2 ln 2 N): a's step from row to row
  float rows[8];  // -b^2
  float opacity;
};

// A Gaussian as the tile sees it whose first pixel's centre is `origin`.
Splat splat_of(vec2 origin, vec2 mean, vec3 conic, float opacity) {
  Splat s;
  precise vec2 d = origin - mean;
  precise float dy = d.y + float(MIDDLE);
  precise float axis = conic.y * dy - d.x;
  precise float scale = sqrt(HALF_LOG2E * conic.x);
  precise float slope = conic.y * scale;
  precise float v = -HALF_LOG2E * conic.z;
  s.axis = axis;
  s.scale = scale;
  s.slope = slope;
  [[unroll]] for (uint r = 0u; r < 8u; r++) {
    precise float y = d.y + float(r);
    // From v on: y^2 alone may overflow.
    precise float row = v * y * y;
    s.rows[r] = row;
  }
  s.opacity = opacity;
  return s;
}

// The one that lane `lane` holds.
Splat of_lane(Splat s, uint lane) {
  Splat o;
  o.axis = subgroupShuffle(s.axis, lane);
  o.scale = subgroupShuffle(s.scale, lane);
  o.slope = subgroupShuffle(s.slope, lane);
  [[unroll]] for (uint r = 0u; r < 8u; r++) o.rows[r] = subgroupShuffle(s.rows[r], lane);
  o.opacity = subgroupShuffle(s.opacity, lane);
  return o;
}

// Opacity times exponential in the rows of the column at `x`, px from the tile's first.
float[8] raw_alphas(Splat s, float x) {
  precise float a[8];
  a[MIDDLE] = (x - s.axis) * s.scale;
  [[unroll]] for (uint r = MIDDLE; r < 7u; r++) a[r + 1u] = a[r] - s.slope;
  [[unroll]] for (uint r = MIDDLE; r > 0u; r--) a[r - 1u] = a[r] + s.slope;
  float raw[8];
  [[unroll]] for (uint r = 0u; r < 8u; r++) {
    precise float power = s.rows[r] - a[r] * a[r];
    precise float value = s.opacity * exp2(power);
    raw[r] = value;
  }
  return raw;
}

// Alpha of a sample, 0 where it is skipped.
float alpha_of(float raw, float alpha_min) {
  float alpha = min(0.99, raw);
  return alpha >= alpha_min ? alpha : 0.0;
}
