#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Second layer's weight and bias gradients: a workgroup sums over one chunk of visible anchors, a thread computes 8 outputs by 8 units
// (and again, where there are more than 64 such tiles).
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Hidden { vec4 hidden[]; };          // [V*24] of decode_hidden
layout(binding = 2, scalar) readonly buffer GradOutput { vec4 grad_output[]; }; // [V*D/4] of decode_backward
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [chunk*(D*8 + D/4)] like the packed second layer and its biases
void sum_tile(uint tile, uint part, uint begin, uint end) {
  uint rows = head_row(3u, OFFSETS), row = 2u * (tile / 4u), column = 2u * (tile % 4u);
  uint head = 4u * row < head_row(1u, OFFSETS) ? 0u : 4u * row < head_row(2u, OFFSETS) ? 1u : 2u;
  vec4 sum[16];
  [[unroll]] for (uint i = 0u; i < 16u; ++i) sum[i] = vec4(0.0);
  vec4 bias0 = vec4(0.0), bias1 = vec4(0.0);
  for (uint v = begin; v < end; ++v) {
    uint h = v * HIDDEN_VEC4 + head * ROW_VEC4 + column, g = v * (rows / 4u) + row;
    vec4 x0 = hidden[h], x1 = hidden[h + 1u], g0 = grad_output[g], g1 = grad_output[g + 1u];
    bias0 += g0;
    bias1 += g1;
    [[unroll]] for (uint i = 0u; i < 4u; ++i) {
      sum[2u * i] = add_scaled(sum[2u * i], g0[i], x0);
      sum[2u * i + 1u] = add_scaled(sum[2u * i + 1u], g0[i], x1);
      sum[2u * i + 8u] = add_scaled(sum[2u * i + 8u], g1[i], x0);
      sum[2u * i + 9u] = add_scaled(sum[2u * i + 9u], g1[i], x1);
    }
  }
  uint from = part * (rows * ROW_VEC4 + rows / 4u);
  [[unroll]] for (uint i = 0u; i < 8u; ++i) {
    uint to = from + (4u * row + i) * ROW_VEC4 + column;
    partial[to] = sum[2u * i];
    partial[to + 1u] = sum[2u * i + 1u];
  }
  if (column == 0u) {
    partial[from + rows * ROW_VEC4 + row] = bias0;
    partial[from + rows * ROW_VEC4 + row + 1u] = bias1;
  }
}
void main() {
  uint n = groups[3], chunk = chunk_anchors(n), part = group_index(), tiles = head_row(3u, OFFSETS) / 2u;
  if (part * chunk >= n) return;
  for (uint tile = gl_LocalInvocationID.x; tile < tiles; tile += 64u) sum_tile(tile, part, part * chunk, min(n, (part + 1u) * chunk));
}
