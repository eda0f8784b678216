#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "tiles.glsl"
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
//
// Front-to-back blending of a tile's Gaussians (3D Gaussian Splatting, equation 3): colour, depth and transmittance.
// 16 x 16 tiles, a thread a pixel; Gaussians pass through shared memory. A band is a row, which is 16 threads': a subgroup
// none of whose bands a Gaussian reaches passes over it. The longest list is what a picture waits for, and a thread of one
// pixel is through with it sooner than one of four. `depth` leaves transmittance out, `color` also depth.
#ifdef COLOR_ONLY
#define NO_TRANSMITTANCE
#endif
const uint TILE = 16u, ROWS = 1u;
layout(local_size_x = 256) in;
layout(constant_id = 0) const float ALPHA_MIN = 0.00392156862745098; // samples below are skipped
layout(constant_id = 1) const float TRANSMITTANCE_MIN = 1e-4; // a pixel is finished before it falls below
layout(binding = 0, scalar) readonly buffer Ranges { uvec2 ranges[]; };         // [tile + 1] first, one past last in the sorted list
layout(binding = 1, scalar) readonly buffer Sorted { uint sorted[]; };          // [pair] pair numbers by tile, nearest first
layout(binding = 2, scalar) readonly buffer PairSlot { uint pair_slot[]; };     // [pair] slot of the Gaussian
layout(binding = 3, scalar) readonly buffer Mean { vec2 mean[]; };              // [slot] px
layout(binding = 4, scalar) readonly buffer Conic { vec3 conic[]; };            // [slot] factored inverse covariance: 1/N px^-2, slope k, 1/V px^-2
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };       // [slot]
layout(binding = 6, scalar) readonly buffer Color { vec3 color[]; };            // [slot] linear rgb
layout(binding = 7, scalar) writeonly buffer Rgb { vec3 rgb[]; };               // [pixel] linear rgb, background included
#ifndef COLOR_ONLY
layout(binding = 8, scalar) readonly buffer Depth { float depth[]; };           // [slot] camera z
layout(binding = 9, scalar) writeonly buffer DepthMap { float depth_map[]; };   // [pixel] sum of z alpha T, not divided by coverage
#endif
#ifndef NO_TRANSMITTANCE
layout(binding = 10, scalar) writeonly buffer Transmittance { float transmittance[]; }; // [pixel] what is left of the background
#endif
layout(binding = 11, scalar) writeonly buffer CutState { float cut_state[]; };  // [cut, 5, 256] the tile's pixels before each cut in its list
layout(push_constant, scalar) uniform Push {
  uvec2 size;      // picture, px
  uint tiles_x;    // tiles in x
  vec3 background; // linear rgb
} push;

float T[ROWS];
vec3 sum_rgb[ROWS];
#ifndef COLOR_ONLY
float sum_z[ROWS];
#endif
bool live[ROWS];
vec2 pixel; // centre of this thread's first pixel

// The exponent is -1/2 of ((dx - k dy)^2 / N + dy^2 / V): two squares, so that it is never positive, and overflows to
// -infinity, never to not-a-number, for the largest means and deviations that `project` lets through. For a needle the
// three terms of the conic's quadratic form would cancel to 2^-22 r^2 / N at a distance of r px along it; here only
// dx - k dy is rounded, to 2^-22 r: at q = 11 and N = 0.3 the exponent is off by 3e-6 r at most.
void blend(vec2 m, vec3 q, float o, vec3 c, float z) {
  float dx = pixel.x - m.x;
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    float dy = pixel.y + float(r) - m.y;
    precise float across = dx - q.y * dy;
    precise float power = -0.5 * (q.x * across * across + q.z * dy * dy);
    float alpha = min(0.99, o * exp(power));
    float after = T[r] * (1.0 - alpha);
    bool hit = live[r] && alpha >= ALPHA_MIN;
    live[r] = live[r] && !(hit && after < TRANSMITTANCE_MIN);
    hit = hit && live[r];
    float w = hit ? alpha * T[r] : 0.0;
    sum_rgb[r] += w * c;
#ifndef COLOR_ONLY
    sum_z[r] += w * z;
#endif
    T[r] = hit ? after : T[r];
  }
}

const uint BATCH = 128u;
shared vec2 s_mean[BATCH];
shared vec3 s_conic[BATCH];
shared float s_opacity[BATCH];
shared uint s_bands[BATCH];
shared vec3 s_color[BATCH];
#ifndef COLOR_ONLY
shared float s_depth[BATCH];
#endif
shared uint s_live;

// Keeps the state of the pixels at a cut, with which the way back begins there.
void put_cut(uint cut, uint t) {
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    uint p = (t / TILE * ROWS + r) * TILE + t % TILE;
    [[unroll]] for (uint c = 0u; c < 3u; c++) cut_state[cut_state_at(cut, c, p)] = live[r] ? sum_rgb[r][c] : 0.0;
    cut_state[cut_state_at(cut, 3u, p)] = live[r] ? T[r] : -1.0;
#ifndef COLOR_ONLY
    cut_state[cut_state_at(cut, 4u, p)] = live[r] ? sum_z[r] : 0.0;
#endif
  }
}

void main() {
  uint tile = gl_WorkGroupID.y * push.tiles_x + gl_WorkGroupID.x;
  uint t = gl_LocalInvocationID.x, band = 1u << (t / TILE);
  uvec2 first = gl_WorkGroupID.xy * TILE + uvec2(t % TILE, t / TILE * ROWS);
  pixel = vec2(first) + 0.5;
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    T[r] = 1.0;
    sum_rgb[r] = vec3(0.0);
#ifndef COLOR_ONLY
    sum_z[r] = 0.0;
#endif
    live[r] = first.x < push.size.x && first.y + r < push.size.y;
  }
  uvec2 range = ranges[tile];
  // The first batch is as short as makes the others begin at multiples of their length: one begins at every cut.
  uint n = BATCH - range.x % BATCH, cut = range.x / CUT + 1u;
  for (uint base = range.x; base < range.y; base += n, n = BATCH) {
    n = min(n, range.y - base);
    uint i = base + t;
    if (base == cut * CUT) put_cut(cut++, t);
    if (t == 0u) s_live = 0u;
    barrier();
    if (t < n) {
      uint g = pair_slot[sorted[i]];
      s_mean[t] = mean[g];
      s_conic[t] = conic[g];
      s_opacity[t] = opacity[g];
      float top = float(gl_WorkGroupID.y * TILE) + 0.5;
      s_bands[t] = support_bands(s_mean[t].y, s_conic[t].z, support_bound(s_opacity[t], ALPHA_MIN), top, ROWS, TILE / ROWS);
      s_color[t] = color[g];
#ifndef COLOR_ONLY
      s_depth[t] = depth[g];
#endif
    }
    bool any_live = false;
    [[unroll]] for (uint r = 0u; r < ROWS; r++) any_live = any_live || live[r];
    if (any_live) atomicOr(s_live, 1u);
    barrier();
    if (s_live == 0u) break;
    for (uint k = 0u; k < n; k++) {
      if ((s_bands[k] & band) == 0u) continue;
#ifdef COLOR_ONLY
      blend(s_mean[k], s_conic[k], s_opacity[k], s_color[k], 0.0);
#else
      blend(s_mean[k], s_conic[k], s_opacity[k], s_color[k], s_depth[k]);
#endif
    }
    barrier();
  }
  // Where all are finished, they are at the cuts behind.
  for (; cut * CUT < range.y; cut++) put_cut(cut, t);
  [[unroll]] for (uint r = 0u; r < ROWS; r++) {
    if (first.x < push.size.x && first.y + r < push.size.y) {
      uint p = (first.y + r) * push.size.x + first.x;
      rgb[p] = sum_rgb[r] + T[r] * push.background;
#ifndef COLOR_ONLY
      depth_map[p] = sum_z[r];
#endif
#ifndef NO_TRANSMITTANCE
      transmittance[p] = T[r];
#endif
    }
  }
}
