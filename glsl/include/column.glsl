// Samples of the narrow rasteriser. Both passes must decide alike about every one: they do it here, and as the wide
// tiles' passes do. Halving is exact, so a lane that holds a Gaussian halves for all who take it.

// The conic with which `raw_alpha` is called.
vec3 halved(vec3 conic) { return vec3(-0.5 * conic.x, conic.y, -0.5 * conic.z); }

// dx - k dy.
float across_of(float dx, float dy, vec3 q) {
  precise float across = dx - q.y * dy;
  return across;
}

// Opacity times exponential: two squares, see `rasterize`.
float raw_alpha(float across, float dy, vec3 q, float opacity) {
  precise float power = q.x * across * across + q.z * dy * dy;
  return opacity * exp(power);
}

// Alpha of a sample, 0 where it is skipped.
float alpha_of(float raw, float alpha_min) {
  float alpha = min(0.99, raw);
  return alpha >= alpha_min ? alpha : 0.0;
}
