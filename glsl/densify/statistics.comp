#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// What growing and pruning look at, gathered over steps. Every slot belongs to one thread.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };         // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Overflow { uint overflow[]; };     // [1] sticky: not 0 skips the step
layout(binding = 2, scalar) readonly buffer Visible { uint visible[]; };       // [visible] anchors in view
layout(binding = 3, scalar) readonly buffer GradMean { vec2 grad_mean[]; };    // [slot] per px; of Gaussians that touch a tile only
layout(binding = 4, scalar) readonly buffer Tiles { uint tiles[]; };           // [slot] tiles touched; 0 where nothing is drawn
layout(binding = 5, scalar) readonly buffer Opacity { float opacity[]; };      // [slot] the Gaussian exists where > 0
layout(binding = 6, scalar) buffer Gradient { float gradient[]; };             // [anchor, offset] sum of gradient norms, per half picture
layout(binding = 7, scalar) buffer Seen { uint seen[]; };                      // [anchor, offset] steps in which it was drawn
layout(binding = 8, scalar) buffer OpacitySum { float opacity_sum[]; };        // [anchor] sum of the positive opacities
layout(binding = 9, scalar) buffer Visits { uint visits[]; };                  // [anchor] steps in which it was in view
layout(push_constant, scalar) uniform Push {
  vec2 half_size; // half the picture, px
  uint offsets;   // slots per visible anchor
  uint touched;   // not 0: a step counts for a Gaussian only where it has a gradient
} push;
void main() {
  uint s = thread_index();
  uint n = groups[3];
  if (overflow[0] != 0u || s >= n * push.offsets) return;
  uint k = s / n;
  uint v = s - k * n;
  uint a = visible[v];
  if (tiles[s] > 0u) {
    uint at = a * push.offsets + k;
    vec2 g = grad_mean[s] * push.half_size;
    // A hypotenuse that neither overflows nor vanishes before it has to.
    float large = max(abs(g.x), abs(g.y));
    float ratio = min(abs(g.x), abs(g.y)) / max(large, 1e-37);
    gradient[at] += large * sqrt(1.0 + ratio * ratio);
    if (push.touched == 0u || large > 0.0) seen[at] += 1u;
  }
  if (k == 0u) {
    float sum = 0.0;
    for (uint i = 0u; i < push.offsets; ++i) sum += max(opacity[i * n + v], 0.0);
    opacity_sum[a] += sum;
    visits[a] += 1u;
  }
}
