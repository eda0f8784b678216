// Real spherical harmonics up to degree 3 as 3D Gaussian Splatting's files mean them: coefficient k of direction d.
float harmonic(uint k, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  switch (k) {
    case 0u: return 0.28209479177387814;
    case 1u: return -0.4886025119029199 * y;
    case 2u: return 0.4886025119029199 * z;
    case 3u: return -0.4886025119029199 * x;
    case 4u: return 1.0925484305920792 * x * y;
    case 5u: return -1.0925484305920792 * y * z;
    case 6u: return 0.31539156525252005 * (2.0 * zz - xx - yy);
    case 7u: return -1.0925484305920792 * x * z;
    case 8u: return 0.5462742152960396 * (xx - yy);
    case 9u: return -0.5900435899266435 * y * (3.0 * xx - yy);
    case 10u: return 2.890611442640554 * x * y * z;
    case 11u: return -0.4570457994644658 * y * (4.0 * zz - xx - yy);
    case 12u: return 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    case 13u: return -0.4570457994644658 * x * (4.0 * zz - xx - yy);
    case 14u: return 1.445305721320277 * z * (xx - yy);
    default: return -0.5900435899266435 * x * (xx - 3.0 * yy);
  }
}
// Unit direction of a vector; without a length there is none.
vec3 direction(vec3 v) {
  float length2 = dot(v, v);
  return length2 > 0.0 ? v * inversesqrt(length2) : vec3(0.0);
}
