#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// variant color: COLOR_ONLY
// variant marked: MARKED
// variant marked_color: MARKED COLOR_ONLY
//
// Gradients of a Gaussian that touches a tile: the sum over its pairs, which lie one behind the other, and from the factors
// of the conic (1/N, k, 1/V) to those of the covariance (N, k, V): dL/dN = -dL/d(1/N) / N^2. Where the pairs do not fit there
// are none, and no gradient. `marked`: a pair without a mark has no gradient, and none is there to be read.
//
// A Gaussian that covers the picture has a pair for every tile: a thread alone would be at it long after all others. Runs
// of more than LONG pairs are summed by the whole subgroup, one after the other, in a fixed tree.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer DrawnCount { uint drawn_count[]; }; // [1] Gaussians that touch a tile
layout(binding = 1, scalar) readonly buffer Drawn { uint drawn[]; };            // [drawn] their slots
layout(binding = 2, scalar) readonly buffer Tiles { uint tiles[]; };            // [slot] tiles touched
layout(binding = 3, scalar) readonly buffer PairCount { uint pair_count[]; };   // [1] pairs; 0 when they do not fit
layout(binding = 4, scalar) readonly buffer FirstPair { uint first_pair[]; };   // [slot] first pair
layout(binding = 5, scalar) readonly buffer Conic { vec3 conic[]; };            // [slot] factored inverse covariance
layout(binding = 6, scalar) readonly buffer PairMean { vec2 pair_mean[]; };     // [pair]
layout(binding = 7, scalar) readonly buffer PairConic { vec3 pair_conic[]; };   // [pair]
layout(binding = 8, scalar) readonly buffer PairOpacity { float pair_opacity[]; }; // [pair]
layout(binding = 9, scalar) readonly buffer PairColor { vec3 pair_color[]; };   // [pair]
layout(binding = 10, scalar) writeonly buffer GradMean { vec2 grad_mean[]; };    // [slot] 1/px
layout(binding = 11, scalar) writeonly buffer GradCovariance { vec3 grad_covariance[]; }; // [slot] of the factors
layout(binding = 12, scalar) writeonly buffer GradOpacity { float grad_opacity[]; }; // [slot]
layout(binding = 13, scalar) writeonly buffer GradColor { vec3 grad_color[]; }; // [slot]
#ifdef MARKED
layout(binding = 16, scalar) readonly buffer Marks { uint marks[]; };           // [pair / 32] a bit for each pair that has a gradient
#endif
#ifndef COLOR_ONLY
layout(binding = 14, scalar) readonly buffer PairDepth { float pair_depth[]; }; // [pair]
layout(binding = 15, scalar) writeonly buffer GradDepth { float grad_depth[]; }; // [slot]
#endif
vec2 m = vec2(0.0);
vec3 g = vec3(0.0), c = vec3(0.0);
float o = 0.0, z = 0.0;

void add(uint p) {
  m += pair_mean[p];
  g += pair_conic[p];
  o += pair_opacity[p];
  c += pair_color[p];
#ifndef COLOR_ONLY
  z += pair_depth[p];
#endif
}

#ifndef MARKED
const uint LONG = 16u;

// Sums the subgroup's long runs; all of its lanes come here. `first` and `n` are of this lane's own run.
void add_long(uint first, uint n) {
  uint lane = gl_SubgroupInvocationID;
  bool waits = n > LONG;
  for (;;) {
    int next = subgroupMin(waits ? int(lane) : int(gl_SubgroupSize));
    if (next == int(gl_SubgroupSize)) break;
    bool own = int(lane) == next;
    uint from = subgroupAdd(own ? first : 0u), count = subgroupAdd(own ? n : 0u);
    vec2 own_m = m;
    vec3 own_g = g, own_c = c;
    float own_o = o, own_z = z;
    m = vec2(0.0);
    g = vec3(0.0);
    c = vec3(0.0);
    o = 0.0;
    z = 0.0;
    for (uint p = lane; p < count; p += gl_SubgroupSize) add(from + p);
    for (uint bit = 1u; bit < gl_SubgroupSize; bit *= 2u) {
      m += subgroupShuffleXor(m, bit);
      g += subgroupShuffleXor(g, bit);
      c += subgroupShuffleXor(c, bit);
      o += subgroupShuffleXor(o, bit);
#ifndef COLOR_ONLY
      z += subgroupShuffleXor(z, bit);
#endif
    }
    if (own) {
      waits = false;
    } else {
      m = own_m;
      g = own_g;
      c = own_c;
      o = own_o;
      z = own_z;
    }
  }
}
#endif

void main() {
  uint i = thread_index();
#ifdef MARKED
  if (i >= drawn_count[0]) return;
  uint s = drawn[i], p = first_pair[s], end = pair_count[0] == 0u ? p : p + tiles[s];
  // CPU drivers run a loop's body once more, masked, when the test at its head fails; a Gaussian drawn has a pair.
  if (p < end) do {
    uint first = p & 31u, n = min(end - p, 32u - first);
    uint bits = marks[p >> 5u] >> first & 0xffffffffu >> (32u - n);
    if (bits != 0u) do {
      add(p + findLSB(bits));
      bits &= bits - 1u;
    } while (bits != 0u);
    p += n;
  } while (p < end);
#else
  bool some = i < drawn_count[0];
  uint s = some ? drawn[i] : 0u, p = some ? first_pair[s] : 0u, n = some && pair_count[0] != 0u ? tiles[s] : 0u;
  if (n <= LONG) {
    for (uint k = 0u; k < n; k++) add(p + k);
  }
  add_long(p, n);
  if (!some) return;
#endif
  vec3 q = conic[s];
  grad_mean[s] = m;
  grad_covariance[s] = vec3(-(q.x * g.x) * q.x, g.y, -(q.z * g.z) * q.z);
  grad_opacity[s] = o;
  grad_color[s] = c;
#ifndef COLOR_ONLY
  grad_depth[s] = z;
#endif
}
