// A camera and its lens (COLMAP's OPENCV model) on normalised coordinates. World to camera is p_camera = R (p - c).
struct Camera {
  vec3 rotation0, rotation1, rotation2; // rows of R
  vec4 lens;         // fx fy cx cy, px
  vec4 distortion;   // k1 k2 p1 p2
  vec4 limits;       // lowest x y, highest x y of the point at which the Jacobian is taken
  float near;        // smallest depth
  float max_radius2; // squared radius at which the polynomial folds back
};
#define CAMERA(push) Camera(push.rotation0, push.rotation1, push.rotation2, push.lens, \
  push.distortion, push.limits, push.near, push.max_radius2)

const float DILATION = 0.3; // px^2, the low-pass of 3DGS

// A point seen from the camera's centre c = high + low (float64, split in two): p - high is exact for points within a
// factor of two of the centre and rounded relative to the result otherwise, so the error is at most 2^-23 |p - c|
// wherever the scene lies. R p + t would lose 2^-24 (|p| + |t|): a tenth of a unit for a scene a million units out.
vec3 from_center(vec3 p, vec3 high, vec3 low) {
  precise vec3 difference = (p - high) - low;
  return difference;
}

// Of a point seen from the camera's centre. `precise`: the discrete decisions below are the same on device and host.
vec3 to_camera(Camera c, vec3 p) {
  precise float x = (c.rotation0.x * p.x + c.rotation0.y * p.y) + c.rotation0.z * p.z;
  precise float y = (c.rotation1.x * p.x + c.rotation1.y * p.y) + c.rotation1.z * p.z;
  precise float z = (c.rotation2.x * p.x + c.rotation2.y * p.y) + c.rotation2.z * p.z;
  return vec3(x, y, z);
}

// In front of the near plane and inside the radius where the lens polynomial still grows. No division by z.
bool in_front(Camera c, vec3 p) {
  precise float radius2 = p.x * p.x + p.y * p.y;
  precise float limit = c.max_radius2 * (p.z * p.z);
  return p.z > c.near && !(radius2 > limit);
}

// Per axis: +1 beyond the upper limit, -1 beyond the lower, 0 inside.
ivec2 beyond(Camera c, vec3 p) {
  precise vec2 low = c.limits.xy * p.z, high = c.limits.zw * p.z;
  return ivec2(p.x > high.x ? 1 : p.x < low.x ? -1 : 0, p.y > high.y ? 1 : p.y < low.y ? -1 : 0);
}

vec2 clamp_to_limits(Camera c, vec2 xy, ivec2 side) {
  return vec2(side.x > 0 ? c.limits.z : side.x < 0 ? c.limits.x : xy.x,
              side.y > 0 ? c.limits.w : side.y < 0 ? c.limits.y : xy.y);
}

vec2 distort(vec4 d, vec2 xy) {
  float x = xy.x, y = xy.y, r2 = x * x + y * y;
  float radial = 1.0 + r2 * (d.x + d.y * r2);
  return vec2(x * radial + 2.0 * d.z * x * y + d.w * (r2 + 2.0 * x * x),
              y * radial + 2.0 * d.w * x * y + d.z * (r2 + 2.0 * y * y));
}

// Derivative of distort: xx, xy = yx, yy.
vec3 distort_jacobian(vec4 d, vec2 xy) {
  float x = xy.x, y = xy.y, r2 = x * x + y * y;
  float radial = 1.0 + r2 * (d.x + d.y * r2), slope = 2.0 * (d.x + 2.0 * d.y * r2);
  return vec3(radial + x * x * slope + 2.0 * d.z * y + 6.0 * d.w * x,
              x * y * slope + 2.0 * d.z * x + 2.0 * d.w * y,
              radial + y * y * slope + 2.0 * d.w * x + 6.0 * d.z * y);
}

// Gradient with respect to xy through distort_jacobian, given the gradient g of its three entries.
vec2 distort_jacobian_backward(vec4 d, vec2 xy, vec3 g) {
  float x = xy.x, y = xy.y, slope = 2.0 * (d.x + 2.0 * d.y * (x * x + y * y)), k = 8.0 * d.y;
  float xxx = x * (3.0 * slope + k * x * x) + 6.0 * d.w;
  float xxy = y * (slope + k * x * x) + 2.0 * d.z;
  float xyy = x * (slope + k * y * y) + 2.0 * d.w;
  float yyy = y * (3.0 * slope + k * y * y) + 6.0 * d.z;
  return vec2(g.x * xxx + g.y * xxy + g.z * xyy, g.x * xxy + g.y * xyy + g.z * yyy);
}

// Rows of d(pixel) / d(camera point), without the factor 1/z, at clamped normalised coordinates.
void perspective(Camera c, vec2 at, vec3 j, out vec3 row0, out vec3 row1) {
  row0 = c.lens.x * vec3(j.x, j.y, -(j.x * at.x + j.y * at.y));
  row1 = c.lens.y * vec3(j.y, j.z, -(j.y * at.x + j.z * at.y));
}

// A row vector in camera coordinates times R: the same in world coordinates.
vec3 to_world(Camera c, vec3 v) { return c.rotation0 * v.x + c.rotation1 * v.y + c.rotation2 * v.z; }
vec3 rotate(Camera c, vec3 v) { return vec3(dot(c.rotation0, v), dot(c.rotation1, v), dot(c.rotation2, v)); }

// Columns of the rotation matrix of quaternion (w, x, y, z), as it is: not normalised here.
mat3 rotation_matrix(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Three standard deviations of the longer axis of a covariance xx xy yy.
float three_sigma(vec3 v) {
  float half_difference = 0.5 * (v.x - v.z);
  return 3.0 * sqrt(0.5 * (v.x + v.z) + sqrt(half_difference * half_difference + v.y * v.y));
}

// The covariance on the picture, factored: C = U U^T + D I with the rows u0, u1 of U = J R Q S, as
//   (N, k, V): V = yy the variance of y, k = xy / yy the slope of x on y, N = det C / yy the variance of x given y,
// so that d^T C^-1 d = (dx - k dy)^2 / N + dy^2 / V, a sum of squares. The entries xx, xy, yy rounded to float32 know
// the narrow axis only to 2^-24 of the long one: det = xx yy - xy^2 is noise for axes from 2^12 : 1 on, however
// carefully the difference is taken. Here nothing large cancels: with m0, m1 the rows of J R Q and n = m0 x m1 (whose
// size does not depend on S), the minors of U are n_i s_j s_k, and by Cauchy and Binet
//   det C = |u0 x u1|^2 + D (|u0|^2 + |u1|^2) + D^2, so that N = D + (|u0 x u1|^2 + D |u0|^2) / V,
// sums of squares: relative error some ten roundings, and of n what the angle between m0 and m1 costs. Of k the error is
// at most some roundings of |u0| |u1| / V, which moves dx - k dy by 2^-22 of the ellipse's extent in x.
// Quotients by V are taken before squares, so that all stays finite up to standard deviations of MAX_DEVIATION.
const float MAX_DEVIATION = 1152921504606846976.0; // 2^60 px; also the largest coordinate of a mean

struct Axes {
  vec3 m0, m1, u0, u1, n;
  float variance; // V, px^2
  float slope;    // k
};

Axes axes_of(vec3 t0, vec3 t1, mat3 q, vec3 s) {
  Axes a;
  a.m0 = t0 * q;
  a.m1 = t1 * q;
  a.u0 = a.m0 * s;
  a.u1 = a.m1 * s;
  a.n = cross(a.m0, a.m1);
  a.variance = dot(a.u1, a.u1) + DILATION;
  a.slope = dot(a.u0, a.u1) / a.variance;
  return a;
}

float narrow_variance(Axes a, vec3 s) {
  float inverse_deviation = inversesqrt(a.variance);
  vec3 minors = (s.yzx * s.zxy) * a.n * inverse_deviation, u0 = a.u0 * inverse_deviation;
  return DILATION + (dot(minors, minors) + DILATION * dot(u0, u0));
}

// h = m0 - k m1, without the cancellation: (D m0 + (s^2 m1) x n) / V. The residual u0 - k u1 is s h.
vec3 residual(Axes a, vec3 s) {
  float inverse_deviation = inversesqrt(a.variance);
  return (DILATION / a.variance) * a.m0 + cross((s * inverse_deviation) * (a.u1 * inverse_deviation), a.n);
}

bool representable(vec2 mean, Axes a, float narrow, float z) {
  const float most = MAX_DEVIATION * MAX_DEVIATION;
  // Written so that not-a-number is not representable.
  return abs(mean.x) <= MAX_DEVIATION && abs(mean.y) <= MAX_DEVIATION && dot(a.u0, a.u0) <= most &&
    a.variance <= most && narrow <= most && abs(a.slope) <= most && z <= most;
}
