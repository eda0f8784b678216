#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Opacities of the visible anchors' Gaussians, and which of them are decoded. A thread computes OPACITIES of TILE anchors.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint TILE = 8u;     // anchors of a thread
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Packed { vec4 packed[]; };     // of decode_pack
layout(binding = 2, scalar) readonly buffer Hidden { vec4 hidden[]; };     // [V*24] of decode_hidden
layout(binding = 3, scalar) writeonly buffer Opacity { float opacity[]; }; // [K*V] -1 to 1; the Gaussian exists where > 0
layout(binding = 4, scalar) writeonly buffer Flags { uint flags[]; };      // [K*V] 1 where the Gaussian is decoded, 0 elsewhere
layout(push_constant, scalar) uniform Push {
  float above; // Gaussians with an opacity above this are decoded
} push;
void main() {
  const uint PARTS = (OFFSETS + OPACITIES - 1u) / OPACITIES;
  uint t = thread_index(), n = groups[3];
  uint first = OPACITIES * (t % PARTS), v = TILE * (t / PARTS);
  if (v >= n) return;
  float sum[OPACITIES * TILE];
  uint from[TILE], row[OPACITIES];
  [[unroll]] for (uint i = 0u; i < OPACITIES; ++i) {
    row[i] = min(first + i, OFFSETS - 1u);
    float bias = packed[FIRST_VEC4 + head_row(3u, OFFSETS) * ROW_VEC4 + row[i] / 4u][row[i] % 4u];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) sum[OPACITIES * a + i] = bias;
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) from[a] = min(v + a, n - 1u) * HIDDEN_VEC4;
  for (uint j = 0u; j < ROW_VEC4; ++j) {
    vec4 w[OPACITIES];
    [[unroll]] for (uint i = 0u; i < OPACITIES; ++i) w[i] = packed[FIRST_VEC4 + row[i] * ROW_VEC4 + j];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) {
      vec4 h = hidden[from[a] + j];
      [[unroll]] for (uint i = 0u; i < OPACITIES; ++i) sum[OPACITIES * a + i] = dot_add(sum[OPACITIES * a + i], h, w[i]);
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    [[unroll]] for (uint i = 0u; i < OPACITIES; ++i) {
      uint k = first + i;
      if (v + a < n && k < OFFSETS) {
        float o = tanh_safe(sum[OPACITIES * a + i]);
        uint slot = k * n + v + a;
        opacity[slot] = o;
        flags[slot] = o > push.above ? 1u : 0u;
      }
    }
  }
}
