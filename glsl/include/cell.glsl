// Cells of a cubic grid around the origin: cell c holds what is nearest to c times its side.

// Cells up to here either way; further out (and where a coordinate is not a number) there are none. An anchor in the
// centre of cell c must be found in c again, or every round would put one more there: its position is c times the side,
// both rounded, and is multiplied by the rounded inverse and rounded, four times 2^-24 of c, which must stay below 1/2.
const float CELL_LIMIT = 2e6;

// One product and one rounding to the nearest, ties to even: the same on every device.
vec3 cell_coordinates(vec3 p, float inverse_size) {
  precise vec3 q = p * inverse_size;
  return roundEven(q);
}
bool cell_exists(vec3 q) { return all(lessThanEqual(abs(q), vec3(CELL_LIMIT))); }

// Where the Gaussian of an offset lies (Scaffold-GS, equation 3).
vec3 gaussian_position(vec3 anchor, vec3 offset, vec3 log_scaling) {
  precise vec3 p = anchor + offset * exp(log_scaling);
  return p;
}

void cell_put(inout uvec3 key, uint value, uint at) {
  uint word = at / 32u, shift = at % 32u;
  for (uint w = 0u; w < 3u; ++w) { // not key[word]: a dynamic index would go through memory
    if (w == word) key[w] |= value << shift;
    if (w == word + 1u && shift > 0u) key[w] |= value >> (32u - shift);
  }
}
// The coordinates above the lowest ones, `bits` of each, one behind the other in 96 bits, x lowest.
uvec3 cell_key(uvec3 above, uvec3 bits) {
  uvec3 key = uvec3(0u);
  cell_put(key, above.x, 0u);
  cell_put(key, above.y, bits.x);
  cell_put(key, above.z, bits.x + bits.y);
  return key;
}
uint cell_get(uvec3 key, uint bits, uint at) {
  uint word = at / 32u, shift = at % 32u, value = 0u;
  for (uint w = 0u; w < 3u; ++w) {
    if (w == word) value |= key[w] >> shift;
    if (w == word + 1u && shift > 0u) value |= key[w] << (32u - shift);
  }
  return bits == 32u ? value : value & ((1u << bits) - 1u);
}
// The inverse of `cell_key`.
uvec3 cell_above(uvec3 key, uvec3 bits) {
  return uvec3(cell_get(key, bits.x, 0u), cell_get(key, bits.y, bits.x), cell_get(key, bits.z, bits.x + bits.y));
}
