#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Sums the chunks' gradients of the first layer's weights in a fixed order: runs of 32 chunks, then the runs.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
layout(constant_id = 1) const uint LANES = 16u;   // threads that share a vec4's runs, a power of two up to 64: 1 where a workgroup has no need of them
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Partial { vec4 partial[]; };            // of decode_backward_first
layout(binding = 2, scalar) writeonly buffer GradWeights { float grad_weights[]; }; // [W] every one of the first layer is written
#include "chunk_sum.glsl"
void main() {
  uint i = group_index() * SUM_WIDTH + sum_column();
  uint n = groups[3], chunk = chunk_anchors(n), chunks = (n + chunk - 1u) / chunk;
  vec4 total = chunk_sum(0u, chunks, FIRST_VEC4, min(i, FIRST_VEC4 - 1u));
  if (i >= FIRST_VEC4 || sum_lane() != 0u) return;
  for (uint c = 0u; c < 4u; ++c) {
    uint w = weight_at(i, c, OFFSETS);
    if (w != PADDING) grad_weights[w] = total[c];
  }
}
