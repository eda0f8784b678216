#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
// One direction: softmax(q k / 8) v over the other side's tokens, online (Milakov and Gimelshein 2018), 32 keys at a time. A
// workgroup: 32 tokens of one head.
layout(local_size_x = 128) in;
#include "thread.glsl"
#include "attention.glsl"
#include "attention_tile.glsl"
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
shared vec4 shares[TILE * STRIDE]; // by key, then by query: exponentials
shared vec4 columns[16u * TILE / 4u]; // what each thread has of its four queries
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + TILE - 1u) / TILE, id = group_index();
  if (id >= blocks * HEADS) return;
  uint head = id / blocks * HEAD, first = TILE * (id % blocks), row = own_row(), column = other_column();
  vec4 o[4] = vec4[4](vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)); // a query's four of 64 values each
  vec4 top = vec4(LOWEST), sum = vec4(0.0); // of the queries; the sum is of this thread's keys alone
  for (uint from = 0u; from < n.y; from += TILE) {
    vec4 s[2];
    TILE_PRODUCTS(s, query, first, n.x - 1u, key, from, n.y - 1u, head)
    s[0] *= 0.125;
    s[1] *= 0.125;
    // Absent keys repeat the last one.
    columns[column * (TILE / 4u) + row] = max(s[0], s[1]);
    barrier();
    vec4 peak = top;
    [[unroll]] for (uint c = 0u; c < 16u; ++c) peak = max(peak, columns[c * (TILE / 4u) + row]);
    vec4 old = mix(exp(top - peak), vec4(0.0), equal(top, vec4(LOWEST)));
    [[unroll]] for (uint i = 0u; i < 2u; ++i) {
      s[i] = from + column + 16u * i < n.y ? exp(s[i] - peak) : vec4(0.0);
      shares[(column + 16u * i) * STRIDE + row] = s[i];
    }
    sum = fma(sum, old, s[0] + s[1]);
    top = peak;
    [[unroll]] for (uint r = 0u; r < 4u; ++r) o[r] *= old[r];
    for (uint k = 0u; k < TILE; k += RUN) {
      barrier();
      run_other[gl_LocalInvocationID.x] = value[min(from + k + gl_LocalInvocationID.x / HEAD, n.y - 1u) * INNER + head + column];
      barrier();
      [[unroll]] for (uint i = 0u; i < RUN; ++i) {
        vec4 p = shares[(k + i) * STRIDE + row], v = run_other[i * HEAD + column];
        [[unroll]] for (uint r = 0u; r < 4u; ++r) o[r] = fma(vec4(p[r]), v, o[r]);
      }
    }
  }
  barrier();
  columns[column * (TILE / 4u) + row] = sum;
  barrier();
  vec4 total = vec4(0.0);
  [[unroll]] for (uint c = 0u; c < 16u; ++c) total += columns[c * (TILE / 4u) + row];
  vec4 inverse = 1.0 / total; // the largest logit's exponential is 1: the sum is at least that
  [[unroll]] for (uint r = 0u; r < 4u; ++r) {
    uint token = first + 4u * row + r;
    if (token < n.x) {
      mixed[token * INNER + head + column] = inverse[r] * o[r];
      if (column == 0u) softmax[token * HEADS + head / HEAD] = vec2(top[r], inverse[r]);
    }
  }
}
