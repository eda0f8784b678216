// What is fitted to a prior: the rendered depth (near = 0), or its disparity 1 / depth, continued below `near` by its
// tangent: finite where nothing was rendered, and its slope pulls empty pixels towards the prior.
float alignable(float depth, float near) {
  if (near == 0.0) return depth;
  return depth >= near ? 1.0 / depth : (2.0 - depth / near) / near;
}
// The power of two that brings the mean of `sum` over `n` values (none negative) between 1/2 and 2, from the exponents
// alone and so the same everywhere. Squares of values in this unit neither overflow nor vanish, however large or small
// the scene: with n values none is above 2 n, and the sum of squares is below 4 n^3, 1e27 for 8191 x 8191 pixels.
float alignable_unit(float n, float sum) {
  int exponent = int(floatBitsToUint(n) >> 23) - int(floatBitsToUint(abs(sum)) >> 23);
  return uintBitsToFloat(uint(clamp(exponent, -126, 126) + 127) << 23);
}
float alignable_slope(float depth, float near) {
  if (near == 0.0) return 1.0;
  float d = max(depth, near);
  return -1.0 / (d * d);
}
