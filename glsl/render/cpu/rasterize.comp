#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
// variant color: COLOR_ONLY
// variant depth: NO_TRANSMITTANCE
//
// `rasterize` for subgroups of 8 (CPU drivers): tiles of 8 x 8 pixels, one subgroup of 8 threads, each with a column.
// Every lane loads a Gaussian, which the others then take from it: there is no shared memory and no barrier. The pairs
// of which a pixel took something are listed for the backward pass: the others, a fifth of those before their tile's
// end on photographs, have no gradient. `depth` leaves transmittance out, `color` also depth.
#ifdef COLOR_ONLY
#define NO_TRANSMITTANCE
#endif
#include "column.glsl"
const uint SIDE = 8u;
const float SMALLEST = 1.17549435e-38; // normal number: what less a pixel takes is none, whether or not the device flushes it
layout(local_size_x = 8) in;
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
layout(binding = 8, scalar) writeonly buffer Blended { uvec2 blended[]; };      // [pair] from a tile's first on: number and slot of its pairs that are seen, nearest first
layout(binding = 9, scalar) writeonly buffer BlendedCount { uint blended_count[]; }; // [tile] how many
#ifndef COLOR_ONLY
layout(binding = 10, scalar) readonly buffer Depth { float depth[]; };          // [slot] camera z
layout(binding = 11, scalar) writeonly buffer DepthMap { float depth_map[]; };  // [pixel] sum of z alpha T, not divided by coverage
#endif
#ifndef NO_TRANSMITTANCE
layout(binding = 12, scalar) writeonly buffer Transmittance { float transmittance[]; }; // [pixel] what is left of the background
#endif
layout(push_constant, scalar) uniform Push {
  uvec2 size;      // picture, px
  uint tiles_x;    // tiles in x
  vec3 background; // linear rgb
} push;

float T[SIDE]; // negative once the pixel is finished
vec3 sum_rgb[SIDE];
#ifndef COLOR_ONLY
float sum_z[SIDE];
#endif

vec2 pixel; // centre of this thread's first pixel

// The largest weight with which this column blends a Gaussian.
float blend(vec2 m, vec3 q, float o, vec3 c, float z) {
  float dx = pixel.x - m.x, largest = 0.0;
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    float dy = pixel.y + float(r) - m.y;
    float alpha = alpha_of(raw_alpha(across_of(dx, dy, q), dy, q, o), ALPHA_MIN);
    // Where nothing is blended it stays: a finished pixel stops again, another one is not below the threshold.
    precise float after = T[r] * (1.0 - alpha);
    bool stop = after < TRANSMITTANCE_MIN;
    float w = stop ? 0.0 : alpha * T[r];
    sum_rgb[r] += w * c;
#ifndef COLOR_ONLY
    sum_z[r] += w * z;
#endif
    largest = max(largest, w);
    T[r] = stop ? -abs(T[r]) : after;
  }
  return largest;
}

void main() {
  uint tile = gl_WorkGroupID.y * push.tiles_x + gl_WorkGroupID.x;
  uint t = gl_SubgroupInvocationID;
  uvec2 size = push.size, first = gl_WorkGroupID.xy * SIDE + uvec2(t, 0u);
  pixel = vec2(first) + 0.5;
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    T[r] = first.x < size.x && first.y + r < size.y ? 1.0 : -1.0;
    sum_rgb[r] = vec3(0.0);
#ifndef COLOR_ONLY
    sum_z[r] = 0.0;
#endif
  }
  uvec2 range = ranges[tile];
  uint base = range.x, listed = range.x;
  // Tested at the end: CPU drivers run a loop's body once more, masked, when the test at its head fails.
  if (base < range.y) do {
    // A lane beyond the end has opacity 0, which no pixel blends.
    uint i = base + t;
    bool some = i < range.y;
    uint p = sorted[some ? i : range.x];
    uint g = pair_slot[p];
    vec2 m = mean[g];
    vec3 q = halved(conic[g]);
    float o = some ? opacity[g] : 0.0;
    vec3 c = color[g];
#ifdef COLOR_ONLY
    float z = 0.0;
#else
    float z = depth[g];
#endif
    uint seen = 0u;
#define TAKE(v, k) subgroupShuffle(v, k)
#define BLEND(k) if (blend(TAKE(m, k), TAKE(q, k), TAKE(o, k), TAKE(c, k), TAKE(z, k)) >= SMALLEST) seen |= 1u << k
    BLEND(0u); BLEND(1u); BLEND(2u); BLEND(3u); BLEND(4u); BLEND(5u); BLEND(6u); BLEND(7u);
    seen |= subgroupShuffleXor(seen, 1u);
    seen |= subgroupShuffleXor(seen, 2u);
    seen |= subgroupShuffleXor(seen, 4u);
    if ((seen >> t & 1u) != 0u) blended[listed + bitCount(seen & ((1u << t) - 1u))] = uvec2(p, g);
    listed += bitCount(seen);
    float largest = T[0];
    [[unroll]] for (uint r = 1u; r < SIDE; r++) largest = max(largest, T[r]);
    if (!subgroupAny(largest > 0.0)) break;
    base += SIDE;
  } while (base < range.y);
  if (t == 0u) blended_count[tile] = listed - range.x;
  [[unroll]] for (uint r = 0u; r < SIDE; r++) {
    if (first.x < size.x && first.y + r < size.y) {
      uint p = (first.y + r) * size.x + first.x;
      float left = abs(T[r]);
      rgb[p] = sum_rgb[r] + left * push.background;
#ifndef COLOR_ONLY
      depth_map[p] = sum_z[r];
#endif
#ifndef NO_TRANSMITTANCE
      transmittance[p] = left;
#endif
    }
  }
}
