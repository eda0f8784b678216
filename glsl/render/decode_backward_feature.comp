#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Back through the first layer to the features. A thread computes 8 features of 4 anchors.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };            // [V] anchors
layout(binding = 2, scalar) readonly buffer Packed { vec4 packed[]; };              // of decode_pack
layout(binding = 3, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; };     // [V*24] of decode_backward_hidden
layout(binding = 4, scalar) writeonly buffer GradFeature { float grad_feature[]; }; // [N*32] visible anchors only
void main() {
  uint t = thread_index(), n = groups[3];
  uint column = 2u * (t % 4u), v = 4u * (t / 4u);
  if (v >= n) return;
  vec4 sum[8];
  [[unroll]] for (uint i = 0u; i < 8u; ++i) sum[i] = vec4(0.0);
  uint from[4];
  [[unroll]] for (uint a = 0u; a < 4u; ++a) from[a] = min(v + a, n - 1u) * HIDDEN_VEC4;
  for (uint r = 0u; r < HIDDEN_VEC4; ++r) {
    vec4 g[4];
    [[unroll]] for (uint a = 0u; a < 4u; ++a) g[a] = grad_hidden[from[a] + r];
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      uint w = (4u * r + c) * INPUT_VEC4 + column;
      vec4 w0 = packed[w], w1 = packed[w + 1u];
      [[unroll]] for (uint a = 0u; a < 4u; ++a) {
        sum[2u * a] = add_scaled(sum[2u * a], g[a][c], w0);
        sum[2u * a + 1u] = add_scaled(sum[2u * a + 1u], g[a][c], w1);
      }
    }
  }
  [[unroll]] for (uint a = 0u; a < 4u; ++a) {
    if (v + a >= n) return;
    uint to = visible[v + a] * FEATURE + 4u * column;
    [[unroll]] for (uint c = 0u; c < 4u; ++c) {
      grad_feature[to + c] = sum[2u * a][c];
      grad_feature[to + 4u + c] = sum[2u * a + 1u][c];
    }
  }
}
