// Sizes of the cross-attention, in vectors of four: 8 heads of 64, features of 32.
const uint HEADS = 8u;
const uint HEAD = 16u;    // vec4 of a head
const uint INNER = 128u;  // vec4 of a token's queries, keys or values
const uint TOKEN = 8u;    // vec4 of a token's features
float sum4(vec4 v) { return (v.x + v.y) + (v.z + v.w); }
// The sides' counts after clamping to the capacity, own side first. One side empty: nothing to attend to, both 0.
uvec2 sides(uint own, uint other, uint capacity) {
  uvec2 n = min(uvec2(own, other), uvec2(capacity));
  return n.x == 0u || n.y == 0u ? uvec2(0u) : n;
}
