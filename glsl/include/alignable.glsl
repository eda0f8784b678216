// What is fitted to a prior: the rendered depth (near = 0), or its disparity 1 / depth, continued below `near` by its
// tangent: finite where nothing was rendered, and its slope pulls empty pixels towards the prior.
float alignable(float depth, float near) {
  if (near == 0.0) return depth;
  return depth >= near ? 1.0 / depth : (2.0 - depth / near) / near;
}
float alignable_slope(float depth, float near) {
  if (near == 0.0) return 1.0;
  float d = max(depth, near);
  return -1.0 / (d * d);
}
