#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "attention.glsl"
// One direction: softmax(q k / 8) v over the other side's tokens, online (Milakov and Gimelshein 2018), two keys at a
// time. A thread: QUERIES tokens of one head, in registers; more of them use each loaded key more often.
#ifndef QUERIES
#define QUERIES 1
#endif
layout(local_size_x = 64) in;
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
const float LOWEST = -3e38; // below every logit; its exponential is 0
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + QUERIES - 1u) / QUERIES;
  uint id = thread_index();
  if (id >= blocks * HEADS) return;
  uint head = (id / blocks) * HEAD, block = id % blocks;
  vec4 q[QUERIES][16], o[QUERIES][16];
  float top[QUERIES], sum[QUERIES];
  [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
    uint at = min(r * blocks + block, n.x - 1u) * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      q[r][d] = 0.125 * query[at + d];
      o[r][d] = vec4(0.0);
    }
    top[r] = LOWEST;
    sum[r] = 0.0;
  }
  for (uint j = 0u; j < n.y; j += 2u) {
    bool second = j + 1u < n.y;
    uint a = j * INNER + head, b = second ? a + INNER : a;
    vec4 s[QUERIES], t[QUERIES];
    [[unroll]] for (uint r = 0u; r < QUERIES; r++) s[r] = t[r] = vec4(0.0);
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 ka = key[a + d], kb = key[b + d];
      [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
        s[r] = fma(q[r][d], ka, s[r]);
        t[r] = fma(q[r][d], kb, t[r]);
      }
    }
    float pa[QUERIES], pb[QUERIES], old[QUERIES];
    [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
      float sa = sum4(s[r]), sb = sum4(t[r]);
      float peak = max(top[r], max(sa, sb)); // an absent second key repeats the first
      old[r] = top[r] == LOWEST ? 0.0 : exp(top[r] - peak);
      pa[r] = exp(sa - peak);
      pb[r] = second ? exp(sb - peak) : 0.0;
      sum[r] = fma(sum[r], old[r], pa[r] + pb[r]);
      top[r] = peak;
    }
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 va = value[a + d], vb = value[b + d];
      [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
        o[r][d] = fma(vec4(pb[r]), vb, fma(vec4(pa[r]), va, old[r] * o[r][d]));
      }
    }
  }
  [[unroll]] for (uint r = 0u; r < QUERIES; r++) {
    uint token = r * blocks + block;
    if (token < n.x) {
      float inverse = 1.0 / sum[r]; // the largest logit's exponential is 1: the sum is at least that
      [[unroll]] for (uint d = 0u; d < 16u; d++) mixed[token * INNER + head + d] = inverse * o[r][d];
      softmax[token * HEADS + head / HEAD] = vec2(top[r], inverse);
    }
  }
}
