#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
//
// `rasterize_backward` for subgroups of 8, as `rasterize_narrow`: only the pairs that it lists are looked at, written
// and marked. Of dL/d exponent = gp a column sums gp, gp y and gp y^2 with y counted from the middle row; the sums over the
// columns' x and y then make those of gp times 1, a, dy, a^2, a dy and dy^2 with a = dx - k dy, which is linear in x and
// y. Counted from the tile, not from the mean, x / sqrt(N) and k y / sqrt(N) are at most 4 / sqrt(0.3) = 7.3: the terms are at
// most some hundred times their sum, so 1e-5 of it is lost at worst (a Gaussian of less than a pixel), else 1e-7.
#ifdef COLOR_ONLY
#define NO_TRANSMITTANCE
#endif
#include "column.glsl"
const uint SIDE = 8u;
layout(local_size_x = 8) in;
layout(constant_id = 0) const float ALPHA_MIN = 0.00392156862745098; // samples below are skipped
layout(constant_id = 1) const float TRANSMITTANCE_MIN = 1e-4; // a pixel is finished before it falls below
layout(binding = 0, scalar) readonly buffer Ranges { uvec2 ranges[]; };         // [tile + 1] first, one past last in the sorted list
layout(binding = 1, scalar) readonly buffer Blended { uvec2 blended[]; };       // [pair] from a tile's first on: number and slot of its pairs that are seen, nearest first
layout(binding = 2, scalar) readonly buffer BlendedCount { uint blended_count[]; }; // [tile] how many
layout(binding = 3, scalar) readonly buffer Mean { vec2 mean[]; };              // [slot] px
layout(binding = 4, scalar) readonly buffer Conic { vec3 conic[]; };            // [slot] factored inverse covariance: 1/N px^-2, slope k, 1/V px^-2
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };       // [slot]
layout(binding = 6, scalar) readonly buffer Color { vec3 color[]; };            // [slot] linear rgb
layout(binding = 7, scalar) readonly buffer Rgb { vec3 rgb[]; };                // [pixel] as rendered
layout(binding = 8, scalar) readonly buffer GradRgb { vec3 grad_rgb[]; };       // [pixel]
layout(binding = 9, scalar) buffer Marks { uint marks[]; };                     // [pair / 32] a bit for each pair that has a gradient, 0 before
layout(binding = 10, scalar) writeonly buffer PairMean { vec2 pair_mean[]; };   // [pair] dL/d mean
layout(binding = 11, scalar) writeonly buffer PairConic { vec3 pair_conic[]; }; // [pair] dL/d factors of the conic: 1/N, k, 1/V
layout(binding = 12, scalar) writeonly buffer PairOpacity { float pair_opacity[]; }; // [pair] dL/d opacity
layout(binding = 13, scalar) writeonly buffer PairColor { vec3 pair_color[]; }; // [pair] dL/d colour
#ifndef COLOR_ONLY
layout(binding = 14, scalar) readonly buffer Depth { float depth[]; };          // [slot] camera z
layout(binding = 15, scalar) readonly buffer DepthMap { float depth_map[]; };   // [pixel] as rendered
layout(binding = 16, scalar) readonly buffer GradDepthMap { float grad_depth_map[]; }; // [pixel]
layout(binding = 17, scalar) writeonly buffer PairDepth { float pair_depth[]; }; // [pair] dL/d z
#endif
#ifndef NO_TRANSMITTANCE
layout(binding = 18, scalar) readonly buffer Transmittance { float transmittance[]; }; // [pixel] as rendered
layout(binding = 19, scalar) readonly buffer GradTransmittance { float grad_transmittance[]; }; // [pixel]
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size;   // picture, px
  uint tiles_x; // tiles in x
} push;

const float CENTRE = 3.5; // of a tile's columns

float T[SIDE]; // 0 once the pixel is finished
float remaining[SIDE]; // S - A_i
vec3 g_rgb[SIDE];
#ifndef COLOR_ONLY
float g_z[SIDE];
#endif

// Sums over pixels for one Gaussian: of gp times 1, y, y^2, x, x^2, x y, of gradients times weights.
struct Sums {
  float one, y, yy, x, xx, xy;
  vec3 color;
  float z;
};

Sums sums_of(Splat splat, float x, vec3 c, float z) {
  float raw[8] = raw_alphas(splat, x);
  Sums s = Sums(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, vec3(0.0), 0.0);
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    float alpha = alpha_of(raw[r], ALPHA_MIN);
    precise float left = 1.0 - alpha;
    precise float after = T[r] * left;
    bool stop = after < TRANSMITTANCE_MIN;
    float w = stop ? 0.0 : alpha * T[r];
    float v = dot(c, g_rgb[r]);
#ifndef COLOR_ONLY
    v += z * g_z[r];
    s.z += w * g_z[r];
#endif
    s.color += w * g_rgb[r];
    float wv = w * v;
    remaining[r] -= wv;
    // alpha dL/d alpha; none where nothing is blended, nor through the clamp at 0.99.
    float gp = raw[r] == alpha && !stop ? wv - remaining[r] * (alpha / left) : 0.0;
    float y = float(r) - float(MIDDLE);
    s.one += gp;
    if (r != MIDDLE) {
      s.y += gp * y;
      s.yy += gp * (y * y);
    }
    T[r] = stop ? 0.0 : after;
  }
  x -= CENTRE;
  s.x = x * s.one;
  s.xx = x * s.x;
  s.xy = x * s.y;
  return s;
}

// Half of a step of eight sums over eight lanes at once: lanes with the bit keep the second's, the others the first's,
// and both add what their partner holds of it. After bits 1, 2 and 4 lane k holds the k-th Gaussian's sums.
Sums meet(Sums a, Sums b, uint bit) {
  bool upper = (gl_SubgroupInvocationID & bit) != 0u;
#define MEET(f) s.f = (upper ? b.f : a.f) + subgroupShuffleXor(upper ? a.f : b.f, bit)
  Sums s;
  MEET(one);
  MEET(y);
  MEET(yy);
  MEET(x);
  MEET(xx);
  MEET(xy);
  MEET(color);
  s.z = 0.0;
#ifndef COLOR_ONLY
  MEET(z);
#endif
  return s;
}

void main() {
  uint tile = gl_WorkGroupID.y * push.tiles_x + gl_WorkGroupID.x;
  uint t = gl_SubgroupInvocationID;
  uvec2 size = push.size, first = gl_WorkGroupID.xy * SIDE + uvec2(t, 0u);
  vec2 origin = vec2(gl_WorkGroupID.xy * SIDE) + 0.5;
  float x = float(t);
  uint base = ranges[tile].x, end = base + blended_count[tile];
  if (base == end) return;
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    bool inside = first.x < size.x && first.y + r < size.y;
    T[r] = inside ? 1.0 : 0.0;
    uint p = inside ? (first.y + r) * size.x + first.x : 0u;
    g_rgb[r] = grad_rgb[p];
    float total = dot(rgb[p], g_rgb[r]);
#ifndef COLOR_ONLY
    g_z[r] = grad_depth_map[p];
    total += depth_map[p] * g_z[r];
#endif
#ifndef NO_TRANSMITTANCE
    total += transmittance[p] * grad_transmittance[p];
#endif
    remaining[r] = inside ? total : 0.0;
  }
  // Tested at the end: CPU drivers run a loop's body once more, masked, when the test at its head fails.
  do {
    // A lane beyond the end has opacity 0, which no pixel blends.
    uint i = base + t;
    bool some = i < end;
    uvec2 pair = blended[some ? i : base];
    uint p = pair.x, g = pair.y;
    vec2 m = mean[g];
    vec3 q = conic[g];
    float o = some ? opacity[g] : 0.0;
    vec3 c = color[g];
#ifdef COLOR_ONLY
    float z = 0.0;
#else
    float z = depth[g];
#endif
    Splat own = splat_of(origin, m, q, o);
#define SUMS(k) sums_of(of_lane(own, k), x, subgroupShuffle(c, k), subgroupShuffle(z, k))
    Sums a = SUMS(0u);
    a = meet(a, SUMS(1u), 1u);
    Sums b = SUMS(2u);
    b = meet(b, SUMS(3u), 1u);
    a = meet(a, b, 2u);
    b = SUMS(4u);
    b = meet(b, SUMS(5u), 1u);
    Sums d = SUMS(6u);
    d = meet(d, SUMS(7u), 1u);
    Sums s = meet(a, meet(b, d, 2u), 4u);
    if (some) {
      // a = at + x - k y and dy = down + y of the sums' x and y. Products from the sums on: the mean may be far.
      float k = q.y, at = CENTRE - own.axis, down = origin.y - m.y + float(MIDDLE);
      float x_one = s.x + at * s.one, x_y = s.xy + at * s.y, x_x = s.xx + at * (s.x + x_one);
      float a_one = x_one - k * s.y, a_y = x_y - k * s.yy, dy_one = s.y + down * s.one;
      float aa = x_x - k * (x_y + a_y), ady = down * a_one + a_y, dydy = down * (dy_one + s.y) + s.yy;
      float gx = q.x * a_one;
      pair_mean[p] = vec2(gx, q.z * dy_one - k * gx);
      pair_conic[p] = vec3(-0.5 * aa, q.x * ady, -0.5 * dydy);
      pair_opacity[p] = s.one / o;
      pair_color[p] = s.color;
#ifndef COLOR_ONLY
      pair_depth[p] = s.z;
#endif
      atomicOr(marks[p >> 5u], 1u << (p & 31u));
    }
    base += SIDE;
  } while (base < end);
}
