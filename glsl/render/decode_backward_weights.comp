#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Sums the chunks' gradients of the first layer's weights in a fixed order: runs of 32 chunks, then the runs.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Partial { vec4 partial[]; };            // of decode_backward_first
layout(binding = 2, scalar) writeonly buffer GradWeights { float grad_weights[]; }; // [W] every one of the first layer is written
void main() {
  uint i = thread_index();
  if (i >= FIRST_VEC4) return;
  uint n = groups[3], chunk = chunk_anchors(n), chunks = (n + chunk - 1u) / chunk;
  vec4 total = vec4(0.0);
  for (uint begin = 0u; begin < chunks; begin += 32u) {
    vec4 run = vec4(0.0);
    for (uint c = begin; c < min(begin + 32u, chunks); ++c) run += partial[c * FIRST_VEC4 + i];
    total += run;
  }
  for (uint c = 0u; c < 4u; ++c) {
    uint w = weight_at(i, c, OFFSETS);
    if (w != PADDING) grad_weights[w] = total[c];
  }
}
