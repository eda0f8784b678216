#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// One direction: softmax(q k / 8) v over the other side's tokens, online (Milakov and Gimelshein 2018), for subgroups of
// 8 (CPU drivers): a subgroup takes 8 QUERIES tokens of one head, QUERIES of them in a lane, and 8 keys at a time, of
// which each lane loads one: a load costs as much as some forty additions there, a shuffle by a constant one.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Query { vec4 query[]; };        // [capacity * 128] of the own side
layout(binding = 2, scalar) readonly buffer Key { vec4 key[]; };            // [capacity * 128] of the other side
layout(binding = 3, scalar) readonly buffer Value { vec4 value[]; };        // [capacity * 128] of the other side
layout(binding = 4, scalar) writeonly buffer Mixed { vec4 mixed[]; };       // [capacity * 128] attended values
layout(binding = 5, scalar) writeonly buffer Softmax { vec2 softmax[]; };   // [capacity * 8] largest logit, 1 / sum of exp
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the queries are inside, 1: around
  uint capacity; // tokens of a side at most
} push;
const uint QUERIES = 4u;
const float LOWEST = -3e38; // below every logit; its exponential is 0
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + 8u * QUERIES - 1u) / (8u * QUERIES);
  uint id = group_index();
  if (id >= blocks * HEADS) return;
  uint lane = gl_SubgroupInvocationID;
  uint h = id / blocks, head = h * HEAD, first = (id % blocks) * 8u * QUERIES + lane;
  vec4 q[QUERIES][16], o[QUERIES][16];
  float top[QUERIES], sum[QUERIES];
  [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
    uint at = min(first + 8u * r, n.x - 1u) * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      q[r][d] = 0.125 * query[at + d];
      o[r][d] = vec4(0.0);
    }
    top[r] = LOWEST;
    sum[r] = 0.0;
  }
  for (uint j = 0u; j < n.y; j += 8u) {
    uint at = min(j + lane, n.y - 1u) * INNER + head;
    float s[QUERIES][8], old[QUERIES];
    [[unroll]] for (uint r = 0u; r < QUERIES; r++) [[unroll]] for (uint c = 0u; c < 8u; c++) s[r][c] = 0.0;
    vec4 their_key[16];
    [[unroll]] for (uint d = 0u; d < 16u; d++) their_key[d] = key[at + d];
    // Not unrolled, so that the instructions stay in their cache.
    for (uint c = 0u; c < 8u; c++) {
      vec4 t[QUERIES];
      [[unroll]] for (uint r = 0u; r < QUERIES; r++) t[r] = vec4(0.0);
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 k = subgroupShuffle(their_key[d], c);
        [[unroll]] for (uint r = 0u; r < QUERIES; r++) t[r] = fma(q[r][d], k, t[r]);
      }
      [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
        float logit = sum4(t[r]);
        [[unroll]] for (uint e = 0u; e < 8u; e++) s[r][e] = e == c ? logit : s[r][e];
      }
    }
    [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
      float peak = top[r];
      [[unroll]] for (uint c = 0u; c < 8u; c++) peak = j + c < n.y ? max(peak, s[r][c]) : peak;
      old[r] = top[r] == LOWEST ? 0.0 : exp(top[r] - peak);
      [[unroll]] for (uint c = 0u; c < 8u; c++) s[r][c] = j + c < n.y ? exp(s[r][c] - peak) : 0.0;
      sum[r] = fma(sum[r], old[r], sum8(s[r]));
      top[r] = peak;
    }
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 their = value[at + d], v[8];
      [[unroll]] for (uint c = 0u; c < 8u; c++) v[c] = subgroupShuffle(their, c);
      [[unroll]] for (uint r = 0u; r < QUERIES; r++) o[r][d] = fma(vec4(old[r]), o[r][d], times8(s[r], v));
    }
  }
  [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
    uint token = first + 8u * r;
    if (token < n.x) {
      float inverse = 1.0 / sum[r]; // the largest logit's exponential is 1: the sum is at least that
      [[unroll]] for (uint d = 0u; d < 16u; d++) mixed[token * INNER + head + d] = inverse * o[r][d];
      softmax[token * HEADS + h] = vec2(top[r], inverse);
    }
  }
}
