#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "tiles.glsl"
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
// narrow subgroups
//
// Gradients of the blending, per (Gaussian, tile) pair.
//
// A pixel is sum_i w_i c_i + T_end background with w_i = alpha_i T_i and T_{i+1} = T_i (1 - alpha_i). With v_i = dL/dw_i =
// c_i . g_rgb + z_i g_z, alpha_i acts through its own weight and through the transmittance of all that lies behind:
//   dL/dalpha_i = T_i v_i - (sum_{j > i} w_j v_j + T_end (background . g_rgb + g_T)) / (1 - alpha_i).
// The bracket is S - A_i: S = rgb . g_rgb + depth g_z + T_end g_T is known from the picture, and A_i = sum_{j <= i} w_j v_j
// grows front to back, as the forward pass goes. As alpha <= 0.99 the divisor is at least 0.01; no chain of divisions.
//
// alpha = min(0.99, o e), e = exp(power), power = -(a^2 / N + dy^2 / V) / 2, a = dx - k dy, (dx, dy) = pixel - mean. With
// gp = dL/dpower = o e dL/dalpha, 0 where the clamp holds:
//   dL/do = e dL/dalpha; dL/dmean = (gp a / N, gp dy / V - k gp a / N); dL/d(1/N) = -gp a^2 / 2; dL/dk = gp a dy / N;
//   dL/d(1/V) = -gp dy^2 / 2.
// The factors before gp a, gp dy and their squares are the Gaussian's own: `Sums` are over pixels, `write` applies them.
//
// Threads: thread t of 128 has column t % 16 of the tile's 16 x 16 pixels, and rows 2 (t / 16) and 2 (t / 16) + 1. BATCH Gaussians
// at a time lie in shared memory, 4 are gone through together: `meet` twice leaves lane k of every four with the k-th's
// sums over the four, further bits add the subgroup's other fours, and lanes 0 to 3 put them down. Then thread t adds what
// the subgroups put down of Gaussian t, in their order, and writes it to the pair's own number: nothing is added
// atomically. A subgroup none of whose bands of rows a Gaussian reaches has no sums of it to make. Every pair of the list is written, also behind the last one blended.
// A workgroup has a tile's list up to the first cut in it, or from a cut to the next: a picture does not wait for its longest
// list. `depth` is for losses on colour and depth, `color` for losses on colour alone.
#ifdef COLOR_ONLY
#define NO_TRANSMITTANCE
#else
#define WITH_DEPTH
#endif
const uint TILE = 16u, THREADS = 128u, ROWS = 2u;
layout(local_size_x = 128) in;
layout(constant_id = 0) const float ALPHA_MIN = 0.00392156862745098; // samples below are skipped
layout(constant_id = 1) const float TRANSMITTANCE_MIN = 1e-4; // a pixel is finished before it falls below
layout(constant_id = 2) const uint SUBGROUPS = 32u; // subgroups of a wide tile's 128 threads; those of four are the most
layout(binding = 0, scalar) readonly buffer Ranges { uvec2 ranges[]; };         // [tile + 1] first, one past last in the sorted list
layout(binding = 1, scalar) readonly buffer Sorted { uint sorted[]; };          // [pair] pair numbers by tile, nearest first
layout(binding = 2, scalar) readonly buffer PairSlot { uint pair_slot[]; };     // [pair] slot of the Gaussian
layout(binding = 3, scalar) readonly buffer Mean { vec2 mean[]; };              // [slot] px
layout(binding = 4, scalar) readonly buffer Conic { vec3 conic[]; };            // [slot] factored inverse covariance: 1/N px^-2, slope k, 1/V px^-2
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };       // [slot]
layout(binding = 6, scalar) readonly buffer Color { vec3 color[]; };            // [slot] linear rgb
layout(binding = 7, scalar) readonly buffer Rgb { vec3 rgb[]; };                // [pixel] as rendered
layout(binding = 8, scalar) readonly buffer GradRgb { vec3 grad_rgb[]; };       // [pixel]
layout(binding = 9, scalar) writeonly buffer PairMean { vec2 pair_mean[]; };    // [pair] dL/d mean
layout(binding = 10, scalar) writeonly buffer PairConic { vec3 pair_conic[]; }; // [pair] dL/d factors of the conic: 1/N, k, 1/V
layout(binding = 11, scalar) writeonly buffer PairOpacity { float pair_opacity[]; }; // [pair] dL/d opacity
layout(binding = 12, scalar) writeonly buffer PairColor { vec3 pair_color[]; }; // [pair] dL/d colour
#ifdef WITH_DEPTH
layout(binding = 13, scalar) readonly buffer Depth { float depth[]; };          // [slot] camera z
layout(binding = 14, scalar) readonly buffer DepthMap { float depth_map[]; };   // [pixel] as rendered
layout(binding = 15, scalar) readonly buffer GradDepthMap { float grad_depth_map[]; }; // [pixel]
layout(binding = 16, scalar) writeonly buffer PairDepth { float pair_depth[]; }; // [pair] dL/d z
#endif
#ifndef NO_TRANSMITTANCE
layout(binding = 17, scalar) readonly buffer Transmittance { float transmittance[]; }; // [pixel] as rendered
layout(binding = 18, scalar) readonly buffer GradTransmittance { float grad_transmittance[]; }; // [pixel]
#endif
layout(binding = 19, scalar) readonly buffer CutTile { uint cut_tile[]; };      // [cut] one more than the tile in whose list it lies, or 0; of cut 0 how many follow
layout(binding = 20, scalar) readonly buffer CutState { float cut_state[]; };   // [cut, 5, 256] the tile's pixels there
layout(push_constant, scalar) uniform Push {
  uvec2 size;   // picture, px
  uint tiles_x; // tiles in x
} push;

float T[ROWS]; // T_i
float remaining[ROWS]; // S - A_i
vec3 g_rgb[ROWS];
float g_z[ROWS];
bool live[ROWS];
vec2 pixel; // centre of this thread's first pixel

// Sums over this thread's pixels for one Gaussian: of gp a, gp dy, gp a^2, gp a dy, gp dy^2 with a = dx - k dy (gp = dL/d exponent).
struct Sums {
  vec2 first;
  vec3 second;
  float opacity;
  vec3 color;
  float z;
};

const Sums NO_SUMS = Sums(vec2(0.0), vec3(0.0), 0.0, vec3(0.0), 0.0);

bool any_live() {
  bool any_pixel = false;
  [[unroll]] for (uint r = 0u; r < ROWS; r++) any_pixel = any_pixel || live[r];
  return any_pixel;
}

Sums sums_of(vec2 m, vec3 q, float o, vec3 c, float z) {
  Sums s = NO_SUMS;
  float dx = pixel.x - m.x;
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    float dy = pixel.y + float(r) - m.y;
    precise float across = dx - q.y * dy;
    precise float power = -0.5 * (q.x * across * across + q.z * dy * dy);
    float e = exp(power);
    float raw = o * e;
    float alpha = min(0.99, raw);
    float after = T[r] * (1.0 - alpha);
    bool hit = live[r] && alpha >= ALPHA_MIN;
    live[r] = live[r] && !(hit && after < TRANSMITTANCE_MIN);
    hit = hit && live[r];
    float w = hit ? alpha * T[r] : 0.0;
    float v = dot(c, g_rgb[r]);
#ifdef WITH_DEPTH
    v += z * g_z[r];
    s.z += w * g_z[r];
#endif
    s.color += w * g_rgb[r];
    remaining[r] -= w * v;
    float g_alpha = T[r] * v - remaining[r] / (1.0 - alpha);
    g_alpha = hit && raw <= 0.99 ? g_alpha : 0.0; // the clamp at 0.99 passes no gradient
    s.opacity += g_alpha * e;
    float gp = g_alpha * raw;
    // Squares overflow for pixels far from the largest Gaussians, where gp is 0: products from gp on.
    vec2 gd = gp * vec2(across, dy);
    s.first += gd;
    s.second += vec3(gd.x * across, gd.x * dy, gd.y * dy);
    T[r] = hit ? after : T[r];
  }
  return s;
}

void write(uint p, vec3 q, Sums s) {
  float gx = q.x * s.first.x;
  pair_mean[p] = vec2(gx, q.z * s.first.y - q.y * gx);
  pair_conic[p] = vec3(-0.5 * s.second.x, q.x * s.second.y, -0.5 * s.second.z);
  pair_opacity[p] = s.opacity;
  pair_color[p] = s.color;
#ifdef WITH_DEPTH
  pair_depth[p] = s.z;
#endif
}

// Half of a step of two sums over the lanes at once: lanes with the bit keep the second's, the others the first's, and
// both add what their partner holds of it. After bits 1 and 2 lane k of four holds the k-th Gaussian's sums over the four.
Sums meet(Sums a, Sums b, uint bit) {
  bool upper = (gl_SubgroupInvocationID & bit) != 0u;
#define MEET(f) s.f = (upper ? b.f : a.f) + subgroupShuffleXor(upper ? a.f : b.f, bit)
  Sums s;
  MEET(first);
  MEET(second);
  MEET(opacity);
  MEET(color);
  s.z = 0.0;
#ifdef WITH_DEPTH
  MEET(z);
#endif
  return s;
}

const uint BATCH = SUBGROUPS > 16u ? 512u / SUBGROUPS : 32u; // what 32 KiB of shared memory hold the sums of
const uint GROUP = 4u; // Gaussians whose sums meet: the fewest lanes a subgroup has
shared uint s_live;
shared vec2 s_mean[BATCH];
shared vec3 s_conic[BATCH];
shared float s_opacity[BATCH];
shared uint s_bands[BATCH];
shared vec3 s_color[BATCH];
#ifdef WITH_DEPTH
shared float s_depth[BATCH];
#endif
shared vec2 s_first[BATCH * SUBGROUPS];
shared vec3 s_second[BATCH * SUBGROUPS];
shared vec3 s_color_sum[BATCH * SUBGROUPS];
shared vec2 s_opacity_depth[BATCH * SUBGROUPS];

// Of a Gaussian in shared memory, in lanes that all come here.
Sums shared_sums(uint k, uint band) {
  if (!subgroupAny((s_bands[k] & band) != 0u)) return NO_SUMS;
#ifdef WITH_DEPTH
  return sums_of(s_mean[k], s_conic[k], s_opacity[k], s_color[k], s_depth[k]);
#else
  return sums_of(s_mean[k], s_conic[k], s_opacity[k], s_color[k], 0.0);
#endif
}

void main() {
  // The parts are the tiles, and then the cuts.
  uint part = group_index(), tiles = push.tiles_x * ((push.size.y + TILE - 1u) / TILE), tile = part, cut = 0u;
  if (part >= tiles) {
    cut = part - tiles + 1u;
    if (cut > cut_tile[0]) return;
    tile = cut_tile[cut] - 1u;
    if (tile >= tiles) return;
  }
  uvec2 range = ranges[tile], corner = uvec2(tile % push.tiles_x, tile / push.tiles_x) * TILE;
  uint base = cut > 0u ? cut * CUT : range.x, last = min(range.y, (base / CUT + 1u) * CUT);
  uint t = gl_LocalInvocationID.x, band = 1u << (t / TILE);
  uvec2 first = corner + uvec2(t % TILE, t / TILE * ROWS);
  pixel = vec2(first) + 0.5;
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    T[r] = 1.0;
    live[r] = first.x < push.size.x && first.y + r < push.size.y;
    uint p = live[r] ? (first.y + r) * push.size.x + first.x : 0u;
    g_rgb[r] = grad_rgb[p];
    float total = dot(rgb[p], g_rgb[r]);
#ifdef WITH_DEPTH
    g_z[r] = grad_depth_map[p];
    total += depth_map[p] * g_z[r];
#endif
#ifndef NO_TRANSMITTANCE
    total += transmittance[p] * grad_transmittance[p];
#endif
    if (cut > 0u) {
      uint at = (t / TILE * ROWS + r) * TILE + t % TILE;
      T[r] = cut_state[cut_state_at(cut, 3u, at)];
      live[r] = T[r] >= 0.0;
      [[unroll]] for (uint c = 0u; c < 3u; c++) total -= cut_state[cut_state_at(cut, c, at)] * g_rgb[r][c];
#ifdef WITH_DEPTH
      total -= cut_state[cut_state_at(cut, 4u, at)] * g_z[r];
#endif
    }
    remaining[r] = total;
  }
  for (; base < last; base += BATCH) {
    uint n = min(BATCH, last - base);
    if (t == 0u) s_live = 0u;
    barrier();
    if (any_live()) atomicOr(s_live, 1u);
    if (t < BATCH) {
      // An entry beyond the end has opacity 0, which no pixel blends.
      bool some = t < n;
      uint g = pair_slot[sorted[some ? base + t : base]];
      s_mean[t] = mean[g];
      s_conic[t] = conic[g];
      s_opacity[t] = some ? opacity[g] : 0.0;
      float top = float(corner.y) + 0.5;
      s_bands[t] = some ? support_bands(s_mean[t].y, s_conic[t].z, support_bound(s_opacity[t], ALPHA_MIN), top, ROWS, TILE / ROWS) : 0u;
      s_color[t] = color[g];
#ifdef WITH_DEPTH
      s_depth[t] = depth[g];
#endif
    }
    barrier();
    if (s_live == 0u) break;
    for (uint k = 0u; k < n; k += GROUP) {
      Sums s = NO_SUMS;
      if (subgroupAny(any_live())) {
        s = shared_sums(k, band);
        s = meet(s, shared_sums(k + 1u, band), 1u);
        Sums b = shared_sums(k + 2u, band);
        b = meet(b, shared_sums(k + 3u, band), 1u);
        s = meet(s, b, 2u);
        for (uint bit = GROUP; bit < min(gl_SubgroupSize, THREADS); bit *= 2u) {
          s.first += subgroupShuffleXor(s.first, bit);
          s.second += subgroupShuffleXor(s.second, bit);
          s.opacity += subgroupShuffleXor(s.opacity, bit);
          s.color += subgroupShuffleXor(s.color, bit);
#ifdef WITH_DEPTH
          s.z += subgroupShuffleXor(s.z, bit);
#endif
        }
      }
      if (gl_SubgroupInvocationID < GROUP) {
        uint at = (k + gl_SubgroupInvocationID) * SUBGROUPS + gl_SubgroupID;
        s_first[at] = s.first;
        s_second[at] = s.second;
        s_color_sum[at] = s.color;
        s_opacity_depth[at] = vec2(s.opacity, s.z);
      }
    }
    barrier();
    if (t < n) {
      Sums s = NO_SUMS;
      for (uint u = 0u; u < gl_NumSubgroups; u++) {
        uint at = t * SUBGROUPS + u;
        s.first += s_first[at];
        s.second += s_second[at];
        s.color += s_color_sum[at];
        s.opacity += s_opacity_depth[at].x;
        s.z += s_opacity_depth[at].y;
      }
      write(sorted[base + t], s_conic[t], s);
    }
    barrier();
  }
  // Behind the last Gaussian that any pixel of the tile can still see.
  for (uint i = base + t; i < last; i += THREADS) write(sorted[i], vec3(0.0), NO_SUMS);
  // Pairs that were counted but touch no tile stand behind the last tile (see bin_expand): the gather reads them too.
  if (part == 0u) {
    uvec2 none = ranges[tiles];
    for (uint i = none.x + t; i < none.y; i += THREADS) write(sorted[i], vec3(0.0), NO_SUMS);
  }
}
