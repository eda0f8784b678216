#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
// variant masked: MASKED
// variant masked_depth: MASKED DEPTH
// The step's photograph and what its mask says: from 8 bits per channel to the losses' arrays.
layout(local_size_x = 64) in;
const float NO_PRIOR = -1e4; // far below what a prior in its own range takes
layout(binding = 0, scalar) readonly buffer Picture { uint picture[]; };  // [pixel] red | green << 8 | blue << 16 | mask << 24, the mask 0 outside, up to 255 inside
layout(binding = 1, scalar) writeonly buffer Target { vec3 target[]; };   // [pixel] rgb in 0 to 1
#ifdef MASKED
layout(binding = 2, scalar) writeonly buffer Weight { float weight[]; };  // [pixel] of the photometric loss
#endif
#ifdef DEPTH
layout(binding = 3, scalar) writeonly buffer Valid { float valid[]; };    // [pixel] 1 outside the mask where there is a prior
layout(binding = 4, scalar) writeonly buffer DepthWeight { float depth_weight[]; }; // [pixel] of the depth L1 loss
layout(binding = 5, scalar) readonly buffer Prior { float prior[]; };     // [pixel] the depth prior; at or below NO_PRIOR there is none
layout(binding = 6, scalar) writeonly buffer Given { float given[]; };    // [pixel] 1 where there is a prior
#endif
layout(push_constant, scalar) uniform Push {
  uint pixels; // width * height
#ifdef MASKED
  float outside; // photometric weight outside the mask
  float inside;  // photometric weight inside
#endif
#ifdef DEPTH
  float depth_outside; // depth weight outside the mask
  float depth_inside;  // depth weight inside
#endif
} push;
void main() {
  uint pixel = thread_index();
  if (pixel >= push.pixels) return;
  uint word = picture[pixel];
  target[pixel] = vec3(word & 255u, word >> 8 & 255u, word >> 16 & 255u) / 255.0;
#ifdef MASKED
  // Both ends exact: a hard mask's weights are those asked for.
  float share = float(word >> 24) / 255.0;
  weight[pixel] = mix(push.outside, push.inside, share);
#endif
#ifdef DEPTH
  bool has = prior[pixel] > NO_PRIOR;
  given[pixel] = has ? 1.0 : 0.0;
  valid[pixel] = has && word >> 24 == 0u ? 1.0 : 0.0;
  depth_weight[pixel] = has ? mix(push.depth_outside, push.depth_inside, share) : 0.0;
#endif
}
