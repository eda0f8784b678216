#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Neural Gaussians of the visible anchors (Scaffold-GS): second layer and activations, of those that are listed. A
// thread computes TILE Gaussians of the same number k, so that each load of a weight serves them all.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint TILE = 8u;     // Gaussians of a thread
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "camera.glsl"
layout(binding = 0, scalar) readonly buffer Segments { uint segments[]; };  // [K+2] of decode_lists
layout(binding = 1, scalar) readonly buffer Listed { uint listed[]; };                   // [list] slots k V + v, ascending
layout(binding = 2, scalar) readonly buffer Visible { uint visible[]; };                 // [V] anchors
layout(binding = 3, scalar) readonly buffer AnchorPosition { vec3 anchor_position[]; };  // [N] world
layout(binding = 4, scalar) readonly buffer Offset { vec3 offset[]; };                   // [N*K] in units of the anchor's scaling
layout(binding = 5, scalar) readonly buffer LogScaling { float log_scaling[]; };         // [N*6] of the offsets 3, of the Gaussians 3
layout(binding = 6, scalar) readonly buffer Packed { vec4 packed[]; };                   // of decode_pack
layout(binding = 7, scalar) readonly buffer Hidden { vec4 hidden[]; };                   // [V*24] of decode_hidden
layout(binding = 8, scalar) writeonly buffer Position { vec3 position[]; };              // [K*V] seen from the camera's centre, world axes; listed ones only
layout(binding = 9, scalar) writeonly buffer Color { vec3 color[]; };                    // [K*V] 0 to 1, likewise
layout(binding = 10, scalar) writeonly buffer Scale { vec3 scale[]; };                   // [K*V] standard deviations, world, likewise
layout(binding = 11, scalar) writeonly buffer Rotation { vec4 rotation[]; };             // [K*V] unit quaternion w x y z, likewise
layout(binding = 12, scalar) writeonly buffer RotationNorm { float rotation_norm[]; };   // [K*V] length of the quaternion before, likewise
layout(push_constant, scalar) uniform Push {
  vec3 center;     // of the camera, world, rounded
  vec3 center_low; // the rest of it
} push;
float bias(uint row) {
  uint rows = head_row(3u, OFFSETS);
  return packed[FIRST_VEC4 + rows * ROW_VEC4 + row / 4u][row % 4u];
}
void main() {
  uint t = thread_index(), n = segments[OFFSETS + 1u];
  RUN_OF(t, TILE, k, begin, end)
  if (begin == end) return;
  uint color_row = head_row(1u, OFFSETS) + 3u * k, cov_row = head_row(2u, OFFSETS) + 7u * k;
  uint v[TILE];
  [[unroll]] for (uint a = 0u; a < TILE; ++a) v[a] = listed[min(begin + a, end - 1u)] - k * n;
  float c[3u * TILE], q[7u * TILE];
  [[unroll]] for (uint i = 0u; i < 3u; ++i) {
    float b = bias(color_row + i);
    [[unroll]] for (uint a = 0u; a < TILE; ++a) c[3u * a + i] = b;
  }
  [[unroll]] for (uint i = 0u; i < 7u; ++i) {
    float b = bias(cov_row + i);
    [[unroll]] for (uint a = 0u; a < TILE; ++a) q[7u * a + i] = b;
  }
  for (uint j = 0u; j < ROW_VEC4; ++j) {
    vec4 w[3];
    [[unroll]] for (uint i = 0u; i < 3u; ++i) w[i] = packed[FIRST_VEC4 + (color_row + i) * ROW_VEC4 + j];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) {
      vec4 h = hidden[v[a] * HIDDEN_VEC4 + ROW_VEC4 + j];
      [[unroll]] for (uint i = 0u; i < 3u; ++i) c[3u * a + i] = dot_add(c[3u * a + i], h, w[i]);
    }
  }
  for (uint j = 0u; j < ROW_VEC4; ++j) {
    vec4 w[7];
    [[unroll]] for (uint i = 0u; i < 7u; ++i) w[i] = packed[FIRST_VEC4 + (cov_row + i) * ROW_VEC4 + j];
    [[unroll]] for (uint a = 0u; a < TILE; ++a) {
      vec4 h = hidden[v[a] * HIDDEN_VEC4 + 2u * ROW_VEC4 + j];
      [[unroll]] for (uint i = 0u; i < 7u; ++i) q[7u * a + i] = dot_add(q[7u * a + i], h, w[i]);
    }
  }
  [[unroll]] for (uint a = 0u; a < TILE; ++a) {
    if (begin + a >= end) return;
    uint slot = k * n + v[a], anchor = visible[v[a]], l = 6u * anchor;
    vec3 spread = exp_saturated(vec3(log_scaling[l], log_scaling[l + 1u], log_scaling[l + 2u]));
    vec3 size = exp_saturated(vec3(log_scaling[l + 3u], log_scaling[l + 4u], log_scaling[l + 5u]));
    // Added to the anchor as the camera sees it, an offset is not rounded to the grid of the world's coordinates.
    position[slot] = from_center(anchor_position[anchor], push.center, push.center_low) + offset[anchor * OFFSETS + k] * spread;
    color[slot] = vec3(sigmoid(c[3u * a]), sigmoid(c[3u * a + 1u]), sigmoid(c[3u * a + 2u]));
    scale[slot] = size * vec3(sigmoid(q[7u * a]), sigmoid(q[7u * a + 1u]), sigmoid(q[7u * a + 2u]));
    vec4 raw = vec4(q[7u * a + 3u], q[7u * a + 4u], q[7u * a + 5u], q[7u * a + 6u]);
    float norm = norm_of(raw);
    rotation[slot] = raw / max(norm, 1e-12); // a zero quaternion stays zero
    rotation_norm[slot] = norm;
  }
}
