#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "alignable.glsl"
// Least squares: w x + q ~ prior, from the sums of both passes. Aligned values are |w| x + q.
layout(local_size_x = 1) in;
layout(binding = 0, scalar) readonly buffer Sums { float sums[]; }; // [7] of `align_means` and `align_moments`
layout(binding = 1, scalar) writeonly buffer Fit { float fit[]; };  // [11] |w|, q, mean x, aligned less prior at the means, w, 1 / sum dx^2 with dx in units, mean prior, 1 / n, units per x, what the means lack of x, of prior
void main() {
  float n = sums[0];
  float unit = n > 0.0 ? alignable_unit(n, sums[1]) : 0.0;
  float scale = 0.0, scaled_mean = 0.0, inverse_n = 0.0, inverse_spread = 0.0; // scale: per unit
  vec2 rest = vec2(0.0);
  precise vec2 mean = vec2(0.0);
  if (n > 0.0) {
    inverse_n = 1.0 / n;
    // The means as the second pass took them, rounded; what they lack is the mean of its distances, and stays apart:
    // added, it would be rounded away again, and everything shifted by mean / deviation roundings.
    mean = vec2(sums[1], sums[2]) * inverse_n;
    // Koenig, Steiner: the moments about the true means.
    vec2 correction = vec2(sums[3], sums[4]) * inverse_n;
    rest = vec2(correction.x / unit, correction.y);
    scaled_mean = mean.x * unit;
    float spread = sums[5] - sums[3] * correction.x;
    float product = sums[6] - sums[3] * correction.y;
    // A standard deviation of 8 roundings of the mean (2^-21) is no shape: w = q = 0, without a gradient. In units, so
    // that it does not depend on the scene's scale; the mean is then about 1. Not a number fails here too.
    float rounding = 4.76837158203125e-7 * max(scaled_mean, 0.5); // at least 1/2, but for a mean of 0
    if (spread > n * rounding * rounding) {
      inverse_spread = 1.0 / spread;
      scale = product * inverse_spread;
    }
  }
  bool singular = inverse_spread == 0.0;
  fit[0] = abs(scale) * unit;
  fit[1] = singular ? 0.0 : mean.y - scale * scaled_mean + (rest.y - scale * rest.x * unit);
  fit[2] = mean.x;
  fit[3] = singular ? 0.0 : rest.y - scale * rest.x * unit + (abs(scale) - scale) * scaled_mean;
  fit[4] = scale * unit;
  fit[5] = inverse_spread;
  fit[6] = singular ? 0.0 : mean.y; // then the aligned values are 0, and less the prior its negative
  fit[7] = inverse_n;
  fit[8] = unit;
  fit[9] = rest.x;
  fit[10] = rest.y;
}
