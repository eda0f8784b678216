#include "camera.glsl"
// What of its light a Gaussian keeps that is drawn wider than it is (Mip-Splatting, Yu et al. 2024, equation 9): the root of
// det S / det C, for its covariance S on the picture and C = S + D I. With C in factors, tr C = N + k^2 V + V and det C = N V,
//   det S / det C = 1 - D (tr C - D) / det C = (1 - D / V) (1 - D / N) - D k^2 / N,
// of which no term is above 1: off by six roundings. Below (1/255)^2 the most opaque Gaussian is not drawn.
const float LEAST_KEPT = 1.0 / 65025.0;

float kept_squared(vec3 factors) {
  if (!(factors.x >= DILATION && factors.z >= DILATION)) return LEAST_KEPT;
  float n = DILATION / factors.x, v = DILATION / factors.z;
  return max((1.0 - v) * (1.0 - n) - n * factors.y * factors.y, LEAST_KEPT);
}
