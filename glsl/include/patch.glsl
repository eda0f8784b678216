// Which pixel a point falls on, and the random order of the tokens.

// Folding of the lens polynomial and points behind the near plane are refused; the order of operations is the twin's.
bool patch_pixel(vec3 p, float near, float max_radius2, vec4 lens, vec4 d, out vec2 pixel) {
  precise float radius2 = p.x * p.x + p.y * p.y;
  precise float limit = max_radius2 * (p.z * p.z);
  pixel = vec2(-1.0);
  if (!(p.z > near) || radius2 > limit) return false; // also where a component is not a number
  precise float x = p.x / p.z;
  precise float y = p.y / p.z;
  precise float r2 = x * x + y * y;
  precise float radial = 1.0 + r2 * (d.x + d.y * r2);
  precise float u = (x * radial + 2.0 * d.z * (x * y)) + d.w * (r2 + 2.0 * (x * x));
  precise float v = (y * radial + 2.0 * d.w * (x * y)) + d.z * (r2 + 2.0 * (y * y));
  precise vec2 at = lens.xy * vec2(u, v) + lens.zw;
  pixel = at;
  return true;
}

// A bijection of 32-bit numbers that spreads every bit.
uint spread(uint v) {
  v = (v ^ (v >> 16u)) * 0x7feb352du;
  v = (v ^ (v >> 15u)) * 0x846ca68bu;
  return v ^ (v >> 16u);
}
// Counter-based: the same numbers for the same seed, step and item, in whatever order they are asked for.
uint random_key(uint seed, uint step, uint item) { return spread(item ^ spread(step ^ spread(seed))); }
