#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the second layer and the ReLU. A thread computes UNITS units of TILE anchors.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint TILE = 8u;     // anchors of a thread
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };            // of decode_pack
layout(binding = 2, scalar) readonly buffer Positive { uint positive[]; };        // [V*6] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { vec4 grad_output[]; };   // [V*D/4] of decode_backward
layout(binding = 4, scalar) writeonly buffer GradHidden { vec4 grad_hidden[]; };  // [V*24] before the ReLU
void main() {
  const uint PARTS = HIDDEN_VEC4 / UNITS_VEC4;
  uint t = thread_index(), n = groups[3];
  // Neighbours have the same head, and so as many rows.
  uint tiles = (n + TILE - 1u) / TILE, part = t / max(tiles, 1u), v = TILE * (t - part * tiles);
  if (n == 0u || part >= PARTS) return;
  uint head = part * UNITS / HIDDEN, column = UNITS_VEC4 * part % ROW_VEC4, stride = head_row(3u, OFFSETS) / 4u;
  vec4 sum[UNITS_VEC4 * TILE];
  [[unroll]] for (uint i = 0u; i < UNITS_VEC4 * TILE; ++i) sum[i] = vec4(0.0);
  uint from[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * stride;
  uint end = head_row(head + 1u, OFFSETS) / 4u;
  for (uint r = head_row(head, OFFSETS) / 4u; r < end; ++r) {
    vec4 g[TILE];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) g[a] = grad_output[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q) {
        vec4 w = packed[FIRST_VEC4 + (4u * r + c) * ROW_VEC4 + column + q];
        [[unroll]] for (uint a = 0u; a < TILE; ++a) sum[UNITS_VEC4 * a + q] = add_scaled(sum[UNITS_VEC4 * a + q], g[a][c], w);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (v + a < n) {
      uint to = (v + a) * HIDDEN_VEC4 + UNITS_VEC4 * part;
      uint bits = positive[(v + a) * POSITIVE + part];
      [[unroll]] for (uint q = 0u; q < UNITS_VEC4; ++q)
        grad_hidden[to + q] = mix(vec4(0.0), sum[UNITS_VEC4 * a + q], positive_at(bits, q));
    }
  }
}
