#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the second layer and the ReLU. A thread computes 8 units of TILE anchors.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };            // of decode_pack
layout(binding = 2, scalar) readonly buffer Hidden { vec4 hidden[]; };            // [V*24] of decode_hidden
layout(binding = 3, scalar) readonly buffer GradOutput { vec4 grad_output[]; };   // [V*D/4] of decode_backward
layout(binding = 4, scalar) writeonly buffer GradHidden { vec4 grad_hidden[]; };  // [V*24] before the ReLU
void main() {
  uint t = thread_index(), n = groups[3];
  uint part = t % 12u, v = TILE * (t / 12u);
  if (v >= n) return;
  uint head = part / 4u, column = 2u * (part % 4u), stride = head_row(3u, OFFSETS) / 4u;
  vec4 sum[2u * TILE];
  [[unroll]] for (uint i = 0u; i < 2u * TILE; ++i) sum[i] = vec4(0.0);
  uint from[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * stride;
  uint end = head_row(head + 1u, OFFSETS) / 4u;
  for (uint r = head_row(head, OFFSETS) / 4u; r < end; ++r) {
    vec4 g[TILE];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) g[a] = grad_output[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      uint w = FIRST_VEC4 + (4u * r + c) * ROW_VEC4 + column;
      vec4 w0 = packed[w], w1 = packed[w + 1u];
      [[unroll]] for (uint a = 0u; a < TILE; ++a) {
        sum[2u * a] = add_scaled(sum[2u * a], g[a][c], w0);
        sum[2u * a + 1u] = add_scaled(sum[2u * a + 1u], g[a][c], w1);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (v + a >= n) return;
    uint to = (v + a) * HIDDEN_VEC4 + 2u * part;
    grad_hidden[to] = mix(vec4(0.0), sum[2u * a], greaterThan(hidden[to], vec4(0.0)));
    grad_hidden[to + 1u] = mix(vec4(0.0), sum[2u * a + 1u], greaterThan(hidden[to + 1u], vec4(0.0)));
  }
}
