#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "thread.glsl"
#include "attention.glsl"
#include "lanes.glsl"
// As attention_backward, for subgroups of 8 (CPU drivers): a subgroup takes 8 QUERIES tokens of one head, QUERIES of them
// in a lane, and 8 of the other side's tokens at a time, of which each lane loads one.
layout(local_size_x = 8) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };                     // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Qk { vec4 qk[]; };                             // [capacity * 128] own
layout(binding = 2, scalar) readonly buffer Value { vec4 value[]; };                       // [capacity * 128] own
layout(binding = 3, scalar) readonly buffer GradMixed { vec4 grad_mixed[]; };              // [capacity * 128] own
layout(binding = 4, scalar) readonly buffer Rows { vec3 rows[]; };                         // [capacity * 8] own
layout(binding = 5, scalar) readonly buffer OtherQk { vec4 other_qk[]; };                  // [capacity * 128]
layout(binding = 6, scalar) readonly buffer OtherValue { vec4 other_value[]; };            // [capacity * 128]
layout(binding = 7, scalar) readonly buffer OtherGradMixed { vec4 other_grad_mixed[]; };   // [capacity * 128]
layout(binding = 8, scalar) readonly buffer OtherRows { vec3 other_rows[]; };              // [capacity * 8]
layout(binding = 9, scalar) writeonly buffer GradQk { vec4 grad_qk[]; };                   // [capacity * 128] own
layout(binding = 10, scalar) writeonly buffer GradValue { vec4 grad_value[]; };            // [capacity * 128] own
layout(push_constant, scalar) uniform Push {
  uint own;      // 0: the side is inside, 1: around
  uint capacity; // tokens of a side at most
} push;
const uint QUERIES = 2u;
void main() {
  uvec2 n = sides(tokens[push.own], tokens[1u - push.own], push.capacity);
  uint blocks = (n.x + 8u * QUERIES - 1u) / (8u * QUERIES);
  uint id = group_index();
  if (id >= blocks * HEADS) return;
  uint lane = gl_SubgroupInvocationID;
  uint h = id / blocks, head = h * HEAD, first = (id % blocks) * 8u * QUERIES + lane;
  vec4 q[QUERIES][16], v[QUERIES][16], g[QUERIES][16], gq[QUERIES][16], gv[QUERIES][16];
  vec3 row[QUERIES];
  [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
    uint token = min(first + 8u * i, n.x - 1u), at = token * INNER + head;
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      q[i][d] = 0.125 * qk[at + d];
      v[i][d] = value[at + d];
      g[i][d] = grad_mixed[at + d];
      gq[i][d] = gv[i][d] = vec4(0.0);
    }
    row[i] = rows[token * HEADS + h];
  }
  for (uint j = 0u; j < n.y; j += 8u) {
    uint token = min(j + lane, n.y - 1u), at = token * INNER + head;
    vec3 their_row = other_rows[token * HEADS + h];
    vec4 their_qk[16], their_value[16], their_grad[16];
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      their_qk[d] = other_qk[at + d];
      their_value[d] = other_value[at + d];
      their_grad[d] = other_grad_mixed[at + d];
    }
    float grad_s[QUERIES][8], share[QUERIES][8];
    [[unroll]] for (uint c = 0u; c < 8u; c++) {
      vec4 s[QUERIES], a[QUERIES], b[QUERIES];
      [[unroll]] for (uint i = 0u; i < QUERIES; i++) s[i] = a[i] = b[i] = vec4(0.0);
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        vec4 k = subgroupShuffle(their_qk[d], c), w = subgroupShuffle(their_value[d], c);
        vec4 e = subgroupShuffle(their_grad[d], c);
        [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
          s[i] = fma(q[i][d], k, s[i]);
          a[i] = fma(g[i][d], w, a[i]);
          b[i] = fma(v[i][d], e, b[i]);
        }
      }
      vec3 other = subgroupShuffle(their_row, c);
      bool present = j + c < n.y; // behind the last token it is repeated
      [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
        float logit = sum4(s[i]);
        // The forward pass formed the logits by the same operations: neither exponent is positive.
        float p = exp(logit - row[i].x) * row[i].y, r = exp(logit - other.x) * other.y;
        grad_s[i][c] = present ? p * (sum4(a[i]) - row[i].z) + r * (sum4(b[i]) - other.z) : 0.0;
        share[i][c] = present ? r : 0.0;
      }
    }
    [[unroll]] for (uint d = 0u; d < 16u; d++) {
      vec4 k[8], e[8];
      [[unroll]] for (uint c = 0u; c < 8u; c++) {
        k[c] = subgroupShuffle(their_qk[d], c);
        e[c] = subgroupShuffle(their_grad[d], c);
      }
      [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
        gq[i][d] += times8(grad_s[i], k);
        gv[i][d] += times8(share[i], e);
      }
    }
  }
  [[unroll]] for (uint i = 0u; i < QUERIES; i++) {
    uint token = first + 8u * i, at = token * INNER + head;
    if (token < n.x) {
      [[unroll]] for (uint d = 0u; d < 16u; d++) {
        grad_qk[at + d] = 0.125 * gq[i][d];
        grad_value[at + d] = gv[i][d];
      }
    }
  }
}
