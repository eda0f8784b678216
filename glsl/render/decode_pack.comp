#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The decoder's weights in rows of vec4, padded with zeros: once per step. And how many slots there are: this pass has
// threads even where no anchor is in view.
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OFFSETS = 10u; // Gaussians per anchor
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Weights { float weights[]; };  // [W] the model's
layout(binding = 1, scalar) readonly buffer Groups { uint groups[]; };     // [4] x, y, z of a dispatch; visible anchors
layout(binding = 2, scalar) writeonly buffer Packed { vec4 packed[]; };    // [96*10 + D*8 + D/4] first layer with its biases, second layer, its biases
layout(binding = 3, scalar) writeonly buffer SlotCount { uint slot_count[]; }; // [1] visible anchors times K
void main() {
  uint i = thread_index();
  if (i == 0u) slot_count[0] = groups[3] * OFFSETS;
  if (i >= packed_weights(OFFSETS)) return;
  vec4 v;
  for (uint c = 0u; c < 4u; ++c) {
    uint w = weight_at(i, c, OFFSETS);
    v[c] = w == PADDING ? 0.0 : weights[w];
  }
  packed[i] = v;
}
