#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "tiles.glsl"
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
// narrow subgroups
//
// Front-to-back blending of a tile's Gaussians (3D Gaussian Splatting, equation 3): colour, depth and transmittance.
// 16 x 16 tiles, a thread a pixel; Gaussians pass through shared memory, and each row of pixels goes through those that reach it:
// a bit each. The longest list is what a picture waits for. So GROUP of them are taken together, whose opacities at the pixel do
// not wait for one another, and are then blended in their order; a Gaussian lies in shared memory as vectors that are read at once.
// `depth` leaves transmittance out, `color` also depth.
#ifdef COLOR_ONLY
#define NO_TRANSMITTANCE
#endif
const uint TILE = 16u;
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

vec2 pixel; // this thread's pixel's centre
float T = 1.0;
vec3 sum_rgb = vec3(0.0);
float sum_z = 0.0;
bool live;

const uint BATCH = 256u, WORDS = BATCH / 32u, GROUP = 4u;
shared vec4 s_place[BATCH + 1u];  // mean, opacity, depth; behind the last one that no pixel blends
shared vec4 s_shape[BATCH + 1u];  // conic, red
shared vec2 s_color[BATCH + 1u];  // green, blue
shared uint s_bands[BATCH];       // rows that it reaches
shared uint s_row[TILE * WORDS];  // [row, word] those of the batch that reach the row
shared uint s_live;

// The exponent is -1/2 of ((dx - k dy)^2 / N + dy^2 / V): two squares, so that it is never positive, and overflows to
// -infinity, never to not-a-number, for the largest means and deviations that `project` lets through. For a needle the
// three terms of the conic's quadratic form would cancel to 2^-22 r^2 / N at a distance of r px along it; here only
// dx - k dy is rounded, to 2^-22 r: at q = 11 and N = 0.3 the exponent is off by 3e-6 r at most.
float alpha_at(vec4 place, vec4 shape) {
  float dx = pixel.x - place.x, dy = pixel.y - place.y;
  precise float across = dx - shape.y * dy;
  precise float power = -0.5 * (shape.x * across * across + shape.z * dy * dy);
  return min(0.99, place.z * exp(power));
}

void blend(float alpha, vec3 c, float z) {
  float after = T * (1.0 - alpha);
  bool hit = live && alpha >= ALPHA_MIN;
  live = live && !(hit && after < TRANSMITTANCE_MIN);
  hit = hit && live;
  float w = hit ? alpha * T : 0.0;
  sum_rgb += w * c;
#ifndef COLOR_ONLY
  sum_z += w * z;
#endif
  T = hit ? after : T;
}

// Keeps the state of the pixels at a cut, with which the way back begins there.
void put_cut(uint cut, uint t) {
  [[unroll]] for (uint c = 0u; c < 3u; c++) cut_state[cut_state_at(cut, c, t)] = live ? sum_rgb[c] : 0.0;
  cut_state[cut_state_at(cut, 3u, t)] = live ? T : -1.0;
#ifndef COLOR_ONLY
  cut_state[cut_state_at(cut, 4u, t)] = live ? sum_z : 0.0;
#endif
}

void main() {
  uint tile = gl_WorkGroupID.y * push.tiles_x + gl_WorkGroupID.x;
  uint t = gl_LocalInvocationID.x, row = t / TILE;
  uvec2 at = gl_WorkGroupID.xy * TILE + uvec2(t % TILE, row);
  pixel = vec2(at) + 0.5;
  bool inside = at.x < push.size.x && at.y < push.size.y;
  live = inside;
  if (t == 0u) {
    s_place[BATCH] = vec4(0.0);
    s_shape[BATCH] = vec4(0.0);
    s_color[BATCH] = vec2(0.0);
  }
  uvec2 range = ranges[tile];
  // The first batch is as short as makes the others begin at multiples of their length: one begins at every cut.
  uint n = BATCH - range.x % BATCH, cut = range.x / CUT + 1u;
  for (uint base = range.x; base < range.y; base += n, n = BATCH) {
    n = min(n, range.y - base);
    if (base == cut * CUT) put_cut(cut++, t);
    if (t == 0u) s_live = 0u;
    uint bands = 0u;
    if (t < n) {
      uint g = pair_slot[sorted[base + t]];
      vec2 m = mean[g];
      vec3 q = conic[g], c = color[g];
      float o = opacity[g], top = float(gl_WorkGroupID.y * TILE) + 0.5;
      bands = support_bands(m.y, q.z, support_bound(o, ALPHA_MIN), top, 1u, TILE);
#ifdef COLOR_ONLY
      s_place[t] = vec4(m, o, 0.0);
#else
      s_place[t] = vec4(m, o, depth[g]);
#endif
      s_shape[t] = vec4(q, c.r);
      s_color[t] = c.gb;
    }
    s_bands[t] = bands;
    barrier();
    if (live) atomicOr(s_live, 1u);
    if (t < TILE * WORDS) {
      uint own = t / WORDS, word = t % WORDS, bits = 0u;
      for (uint j = 0u; j < 32u; j++) {
        uint k = (j + word * 4u) % 32u; // threads beside each other read other banks
        bits |= (s_bands[word * 32u + k] >> own & 1u) << k;
      }
      s_row[t] = bits;
    }
    barrier();
    if (s_live == 0u) break;
    for (uint word = 0u; word * 32u < n; word++) {
      uint bits = s_row[row * WORDS + word];
      while (bits != 0u && live) {
        uint k[GROUP];
        float alpha[GROUP];
        [[unroll]] for (uint j = 0u; j < GROUP; j++) {
          k[j] = bits == 0u ? BATCH : word * 32u + uint(findLSB(bits));
          bits &= bits - 1u;
          alpha[j] = alpha_at(s_place[k[j]], s_shape[k[j]]);
        }
        [[unroll]] for (uint j = 0u; j < GROUP; j++) blend(alpha[j], vec3(s_shape[k[j]].w, s_color[k[j]]), s_place[k[j]].w);
      }
    }
    barrier();
  }
  // Where all are finished, they are at the cuts behind.
  for (; cut * CUT < range.y; cut++) put_cut(cut, t);
  if (!inside) return;
  uint p = at.y * push.size.x + at.x;
  rgb[p] = sum_rgb + T * push.background;
#ifndef COLOR_ONLY
  depth_map[p] = sum_z;
#endif
#ifndef NO_TRANSMITTANCE
  transmittance[p] = T;
#endif
}
