// Sums over the 8 elements that the lanes of a subgroup of 8 hold one of each, as trees.
float sum8(float v[8]) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }
vec4 times8(float a[8], vec4 v[8]) {
  return ((a[0] * v[0] + a[1] * v[1]) + (a[2] * v[2] + a[3] * v[3])) + ((a[4] * v[4] + a[5] * v[5]) + (a[6] * v[6] + a[7] * v[7]));
}
