#version 460
// variant inside: INSIDE
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// One gradient of one side's tokens from a matrix of attention_pairs_backward: y_i = sum_j m_ij x_j in every head. For
// subgroups of 8 (CPU drivers): a subgroup takes 32 tokens of one head, 4 neighbours in a lane, and 8 of the other side's
// tokens at a time, of which each lane loads one. The rows of the matrix are those of the tokens around.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };        // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Pairs { vec4 pairs[]; };          // [8 * capacity * stride] in rows of the tokens around
layout(binding = 2, scalar) readonly buffer Other { vec4 other[]; };          // [capacity * 128] of the other side
layout(binding = 3, scalar) writeonly buffer Applied { vec4 applied[]; };     // [capacity * 128] of the own side
layout(push_constant, scalar) uniform Push {
  uint capacity; // tokens of a side at most
  uint stride;   // vec4 of a row: a token around, all tokens inside
} push;
#ifdef INSIDE
const uint OWN = 0u;
#else
const uint OWN = 1u;
#endif
void main() {
  uvec2 n = sides(tokens[OWN], tokens[1u - OWN], push.capacity);
  uint blocks = (n.x + 31u) / 32u;
  uint id = group_index();
  if (id >= blocks * HEADS) return;
  uint lane = gl_SubgroupInvocationID, h = id / blocks, head = h * HEAD, first = (id % blocks) * 32u + 4u * lane;
  vec4 y[4][16];
  [[unroll]] for (uint i = 0u; i < 4u; i++) [[unroll]] for (uint d = 0u; d < 16u; d++) y[i][d] = vec4(0.0);
  uint stride = push.stride;
#ifdef INSIDE
  uint from = h * push.capacity * stride + min(first, n.x - 1u) / 4u;
#else
  uint from[4];
  [[unroll]] for (uint i = 0u; i < 4u; i++) from[i] = (h * push.capacity + min(first + i, n.x - 1u)) * stride;
#endif
  for (uint j = 0u; j < n.y; j += 8u) {
    uint at = min(j + lane, n.y - 1u) * INNER + head;
    float m[4][8];
#ifdef INSIDE
    [[unroll]] for (uint c = 0u; c < 8u; c++) {
      vec4 a = j + c < n.y ? pairs[from + min(j + c, n.y - 1u) * stride] : vec4(0.0);
      [[unroll]] for (uint i = 0u; i < 4u; i++) m[i][c] = a[i];
    }
#else
    [[unroll]] for (uint i = 0u; i < 4u; i++) {
      vec4 a = pairs[from[i] + j / 4u], b = pairs[from[i] + j / 4u + 1u];
      m[i] = float[8](a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w);
      // Behind the last token anything may be.
      [[unroll]] for (uint c = 0u; c < 8u; c++) m[i][c] = j + c < n.y ? m[i][c] : 0.0;
    }
#endif
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 mine = other[at + d], x[8];
      [[unroll]] for (uint c = 0u; c < 8u; c++) x[c] = subgroupShuffle(mine, c);
      [[unroll]] for (uint i = 0u; i < 4u; i++) y[i][d] += times8(m[i], x);
    }
  }
  [[unroll]] for (uint i = 0u; i < 4u; i++) {
    uint token = first + i;
    if (token < n.x) {
      [[unroll]] for (uint d = 0u; d < 16u; d++) applied[token * INNER + head + d] = y[i][d];
    }
  }
}
