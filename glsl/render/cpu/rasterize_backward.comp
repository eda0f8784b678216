#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
//
// `rasterize_backward` for subgroups of 8, as `rasterize` here: only the pairs that it lists are looked at, written and
// marked. The derivation is there, with alpha dL/dalpha = w v - (S - A) alpha / (1 - alpha) in place of dL/dalpha: that is
// gp where the clamp does not hold, and gp / o is dL/do.
//
// Threads: lane t has column t of the tile's 8 x 8 pixels, its 8 rows in registers. Each lane loads one of 8 Gaussians; all
// take them in turn by shuffles. `meet` with bits 1, 2 and 4 leaves lane k with the sums of Gaussian k over the tile,
// which lane k had loaded: it writes them.
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

float T[SIDE]; // 0 once the pixel is finished
float remaining[SIDE]; // S - A_i
vec3 g_rgb[SIDE];
#ifndef COLOR_ONLY
float g_z[SIDE];
#endif

vec2 pixel; // centre of this thread's first pixel

// Sums over pixels for one Gaussian: of gp, gp a, gp dy, gp a^2, gp a dy, gp dy^2 with a = dx - k dy (gp = dL/d exponent).
struct Sums {
  float power;
  vec2 first;
  vec3 second;
  vec3 color;
  float z;
};

Sums sums_of(vec2 m, vec3 q, float o, vec3 c, float z) {
  Sums s = Sums(0.0, vec2(0.0), vec3(0.0), vec3(0.0), 0.0);
  float dx = pixel.x - m.x;
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    float dy = pixel.y + float(r) - m.y, across = across_of(dx, dy, q);
    float raw = raw_alpha(across, dy, q, o), alpha = alpha_of(raw, ALPHA_MIN);
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
    float gp = raw == alpha && !stop ? wv - remaining[r] * (alpha / left) : 0.0;
    s.power += gp;
    // Squares overflow for pixels far from the largest Gaussians, where gp is 0: products from gp on.
    vec2 gd = gp * vec2(across, dy);
    s.first += gd;
    s.second += vec3(gd.x * across, gd.x * dy, gd.y * dy);
    T[r] = stop ? 0.0 : after;
  }
  return s;
}

// Half of a step of eight sums over eight lanes at once: lanes with the bit keep the second's, the others the first's,
// and both add what their partner holds of it. After bits 1, 2 and 4 lane k holds the k-th Gaussian's sums.
Sums meet(Sums a, Sums b, uint bit) {
  bool upper = (gl_SubgroupInvocationID & bit) != 0u;
#define MEET(f) s.f = (upper ? b.f : a.f) + subgroupShuffleXor(upper ? a.f : b.f, bit)
  Sums s;
  MEET(power);
  MEET(first);
  MEET(second);
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
  pixel = vec2(first) + 0.5;
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
    vec3 q = conic[g], half_q = halved(q);
    float o = some ? opacity[g] : 0.0;
    vec3 c = color[g];
#ifdef COLOR_ONLY
    float z = 0.0;
#else
    float z = depth[g];
#endif
#define TAKE(v, k) subgroupShuffle(v, k)
#define SUMS(k) sums_of(TAKE(m, k), TAKE(half_q, k), TAKE(o, k), TAKE(c, k), TAKE(z, k))
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
      float gx = q.x * s.first.x;
      pair_mean[p] = vec2(gx, q.z * s.first.y - q.y * gx);
      pair_conic[p] = vec3(-0.5 * s.second.x, q.x * s.second.y, -0.5 * s.second.z);
      pair_opacity[p] = s.power / o;
      pair_color[p] = s.color;
#ifndef COLOR_ONLY
      pair_depth[p] = s.z;
#endif
      atomicOr(marks[p >> 5u], 1u << (p & 31u));
    }
    base += SIDE;
  } while (base < end);
}
