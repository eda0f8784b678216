#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// variant fixed_offset: FIXED_OFFSET
// variant fixed_scaling: FIXED_SCALING
// variant fixed: FIXED_OFFSET FIXED_SCALING
//
// Back through the activations of the Gaussians that exist: gradients of offsets and log-scales, and of the second layer's
// outputs. Those that touch no tile have none, but what is not a number among their values becomes one. A thread per visible
// anchor; or, on GPUs, one for each of its Gaussians: those of neighbours write neighbouring outputs, and what they add up for the
// anchor is added in their order, as by one thread.
// The variants leave out the gradients of offsets or of log-scales that are not trained.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint EACH = 0u;     // anchors of a workgroup with a thread for each Gaussian, at most 64 / OFFSETS; 0: a thread an anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };                // [V] anchors
#ifndef FIXED_SCALING
layout(binding = 2, scalar) readonly buffer Offset { vec3 offset[]; };                  // [N*K]
#endif
layout(binding = 3, scalar) readonly buffer LogScaling { float log_scaling[]; };        // [N*6]
layout(binding = 4, scalar) readonly buffer Drawn { uint drawn[]; };                    // [K*V] 0 where the Gaussian has no gradient, whatever the arrays hold
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };              // [K*V] of decode
layout(binding = 6, scalar) readonly buffer Color { vec3 color[]; };                    // [K*V] of decode
layout(binding = 7, scalar) readonly buffer Scale { vec3 scale[]; };                    // [K*V] of decode
layout(binding = 8, scalar) readonly buffer Rotation { vec4 rotation[]; };              // [K*V] of decode
layout(binding = 9, scalar) readonly buffer RotationNorm { float rotation_norm[]; };    // [K*V] of decode
#if !defined(FIXED_OFFSET) || !defined(FIXED_SCALING)
layout(binding = 10, scalar) readonly buffer GradPosition { vec3 grad_position[]; };     // [K*V]
#endif
layout(binding = 11, scalar) readonly buffer GradOpacity { float grad_opacity[]; };     // [K*V]
layout(binding = 12, scalar) readonly buffer GradColor { vec3 grad_color[]; };          // [K*V]
layout(binding = 13, scalar) readonly buffer GradScale { vec3 grad_scale[]; };          // [K*V]
layout(binding = 14, scalar) readonly buffer GradRotation { vec4 grad_rotation[]; };    // [K*V]
#ifndef FIXED_OFFSET
layout(binding = 15, scalar) writeonly buffer GradOffset { vec3 grad_offset[]; };       // [N*K] of Gaussians that exist only
#endif
#ifndef FIXED_SCALING
layout(binding = 16, scalar) writeonly buffer GradLogScaling { float grad_log_scaling[]; }; // [N*6] visible anchors only
#endif
layout(binding = 17, scalar) writeonly buffer GradOutput { vec4 grad_output[]; };       // [V*D/4] before the activations, of Gaussians that exist only
layout(push_constant, scalar) uniform Push {
  float above; // Gaussians with an opacity above this exist
} push;
void put(uint from, uint row, float value) { grad_output[from + row / 4u][row % 4u] = value; }
#ifndef FIXED_SCALING
vec3 grad_spread = vec3(0.0), grad_size = vec3(0.0);
shared float s_sums[64u * 6u];
#endif

// Writes the gradients of Gaussian k of visible anchor v, which has opacity o.
void back(uint v, uint n, uint anchor, uint k, float o, vec3 spread, vec3 size) {
  uint rows = head_row(3u, OFFSETS), to = v * (rows / 4u), color_row = head_row(1u, OFFSETS), cov_row = head_row(2u, OFFSETS);
  uint slot = k * n + v;
  bool has = drawn[slot] != 0u;
#if !defined(FIXED_OFFSET) || !defined(FIXED_SCALING)
  vec3 gp = has ? grad_position[slot] : vec3(0.0);
#endif
#ifndef FIXED_OFFSET
  grad_offset[anchor * OFFSETS + k] = gp * spread;
#endif
#ifndef FIXED_SCALING
  // By the displacement, which is finite where there is a Gaussian: the gradient of an offset of 0 may overflow, this not.
  grad_spread += gp * (offset[anchor * OFFSETS + k] * spread);
#endif
  put(to, k, (has ? grad_opacity[slot] : 0.0) * ((1.0 - o) * (1.0 + o)));
  vec3 c = color[slot], gc = (has ? grad_color[slot] : vec3(0.0)) * c * (1.0 - c);
  put(to, color_row + 3u * k, gc.x);
  put(to, color_row + 3u * k + 1u, gc.y);
  put(to, color_row + 3u * k + 2u, gc.z);
  vec3 s = scale[slot], gs = (has ? grad_scale[slot] : vec3(0.0)) * s;
#ifndef FIXED_SCALING
  grad_size += gs;
#endif
  // The sigmoid is scale / size; of a size that underflowed to 0 the scale and its gradient are 0.
  gs *= 1.0 - s / max(size, vec3(1e-37));
  vec4 q = rotation[slot], gq = has ? grad_rotation[slot] : vec4(0.0);
  float norm = rotation_norm[slot];
  gq = norm < 1e-12 ? gq / 1e-12 : (gq - q * dot(q, gq)) / norm;
  uint row = cov_row + 7u * k;
  put(to, row, gs.x);
  put(to, row + 1u, gs.y);
  put(to, row + 2u, gs.z);
  put(to, row + 3u, gq.x);
  put(to, row + 4u, gq.y);
  put(to, row + 5u, gq.z);
  put(to, row + 6u, gq.w);
}

vec3 lengths(uint l) {
  return exp_saturated(vec3(log_scaling[l], log_scaling[l + 1u], log_scaling[l + 2u]));
}

void main() {
  uint n = groups[3];
  float above = push.above;
  if (EACH == 0u) {
    uint v = thread_index();
    if (v >= n) return;
    uint anchor = visible[v];
    vec3 spread = lengths(6u * anchor), size = lengths(6u * anchor + 3u);
    for (uint k = 0u; k < OFFSETS; ++k) {
      // Each thread goes on to its own next one that exists: of threads that run in step the loop then lasts as long as the
      // most that any of them has, not K.
      float o = 0.0;
      while (k < OFFSETS && !((o = opacity[k * n + v]) > above)) ++k;
      if (k >= OFFSETS) break;
      back(v, n, anchor, k, o, spread, size);
    }
#ifndef FIXED_SCALING
    for (uint i = 0u; i < 3u; ++i) {
      grad_log_scaling[6u * anchor + i] = grad_spread[i];
      grad_log_scaling[6u * anchor + 3u + i] = grad_size[i];
    }
#endif
  } else {
    uint t = gl_LocalInvocationID.x, a = t / OFFSETS, k = t % OFFSETS, v = group_index() * EACH + a;
    bool some = a < EACH && v < n;
    uint anchor = some ? visible[v] : 0u;
    float o = some ? opacity[k * n + v] : 0.0;
    if (some && o > above) back(v, n, anchor, k, o, lengths(6u * anchor), lengths(6u * anchor + 3u));
#ifndef FIXED_SCALING
    for (uint i = 0u; i < 3u; ++i) {
      s_sums[6u * t + i] = grad_spread[i];
      s_sums[6u * t + 3u + i] = grad_size[i];
    }
    barrier();
    if (!some) return;
    for (uint i = k; i < 6u; i += OFFSETS) {
      float sum = 0.0;
      for (uint j = 0u; j < OFFSETS; ++j) sum += s_sums[6u * (a * OFFSETS + j) + i];
      grad_log_scaling[6u * anchor + i] = sum;
    }
#endif
  }
}
