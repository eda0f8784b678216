#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
// How well a site's surroundings agree with four other pictures if they lie on a plane: one less the correlation of the
// grey values over a window (ZNCC), in which pixels of other values and far ones count less; of the four views the mean of
// the two that agree best, because something may stand in the way of the others.
//
// A plane's inverse depth is linear in the pixel, w = w0 + wx (x - x0) + wy (y - y0), and the pixel (x, y) of inverse depth
// w is seen by another view at A (x, y, 1) + b w, divided by its third component. Within the window that is taken to be
// affine. A picture's element holds four grey values, so that a value between pixels is one load.
layout(local_size_x = 64) in;
#include "thread.glsl"
layout(binding = 0, scalar) readonly buffer Picture { uint picture[]; };      // [pixel] grey values of it, the right, the lower and the lower right one, 8 bits each
layout(binding = 1, scalar) readonly buffer First { uint first[]; };          // [pixel] the same of the four views
layout(binding = 2, scalar) readonly buffer Second { uint second[]; };        // [pixel]
layout(binding = 3, scalar) readonly buffer Third { uint third[]; };          // [pixel]
layout(binding = 4, scalar) readonly buffer Fourth { uint fourth[]; };        // [pixel]
layout(binding = 5, scalar) readonly buffer Relation { vec4 relation[]; };    // [14] per view: rows of A with b behind each, width, height (0: no such view)
layout(binding = 6, scalar) readonly buffer Candidate { vec3 candidate[]; };  // [candidate][site of the colour] as `propose` has it
layout(binding = 7, scalar) writeonly buffer Score { float score[]; };        // [candidate][site of the colour] 0 (they agree) to 2
layout(push_constant, scalar) uniform Push {
  uvec2 size;  // of the picture
  uvec2 sites; // columns, rows
  uint color;  // as in `propose`
  uint stride; // pixels from site to site
  uint views;  // 1 to 4
} push;
const uint CANDIDATES = 12u;
const int HALF_WINDOW = 2;        // samples
const int SPACING = 2;            // pixels from sample to sample
const float COLOR = 1.0 / 12.0;   // per grey value: a difference of 12 halves a sample's weight
const float DISTANCE = 0.05;      // per square pixel, likewise
const float NOISE = 4.0;          // variance of grey values that tells nothing
const float MARGIN = 1.0;         // pixels from the border within which a view does not see
const float WORST = 2.0;
void main() {
  uint columns = push.sites.x, per_row = (columns + 1u) / 2u, n = per_row * push.sites.y, t = thread_index();
  if (t >= n * CANDIDATES) return;
  uint i = t % n, y = i / per_row, x = 2u * (i - y * per_row) + ((y + push.color) & 1u);
  if (x >= columns) return;
  ivec2 at = ivec2(uvec2(x, y) * push.stride + push.stride / 2u), last = ivec2(push.size) - 1;
  vec2 p = vec2(at) + 0.5;
  vec3 plane = candidate[t];
  vec4 width = relation[12], height = relation[13];
  vec4 tu = relation[3], tv = relation[7], tz = relation[11];
  vec4 qu = relation[0] * p.x + relation[1] * p.y + relation[2] + tu * plane.x;
  vec4 qv = relation[4] * p.x + relation[5] * p.y + relation[6] + tv * plane.x;
  vec4 qz = relation[8] * p.x + relation[9] * p.y + relation[10] + tz * plane.x;
  vec4 over = 1.0 / qz, u = qu * over, v = qv * over;
  bvec4 seen = greaterThan(qz, vec4(0.0));
  for (int k = 0; k < 4; k++) {
    seen[k] = seen[k] && u[k] > MARGIN && v[k] > MARGIN && u[k] < width[k] - MARGIN && v[k] < height[k] - MARGIN;
  }
  vec4 zx = relation[8] + tz * plane.y, zy = relation[9] + tz * plane.z;
  const vec4 none = vec4(0.0);
  // What is not seen is looked up at the first pixel.
  vec4 ux = mix(none, (relation[0] + tu * plane.y - u * zx) * over, seen);
  vec4 uy = mix(none, (relation[1] + tu * plane.z - u * zy) * over, seen);
  vec4 vx = mix(none, (relation[4] + tv * plane.y - v * zx) * over, seen);
  vec4 vy = mix(none, (relation[5] + tv * plane.z - v * zy) * over, seen);
  u = mix(none, u - 0.5, seen);
  v = mix(none, v - 0.5, seen);
  // The last pixel whose right and lower neighbours exist, and nearly all of the way to them.
  vec4 right = max(width - 1.01, 0.0), low = max(height - 1.01, 0.0);
  uvec4 wide = uvec4(width);
  float center = float(picture[uint(at.y) * push.size.x + uint(at.x)] & 255u);
  float sum = 0.0, sum_a = 0.0, sum_aa = 0.0;
  vec4 sum_b = none, sum_bb = none, sum_ab = none;
  for (int j = -HALF_WINDOW; j <= HALF_WINDOW; j++) {
    for (int i = -HALF_WINDOW; i <= HALF_WINDOW; i++) {
      ivec2 offset = ivec2(i, j) * SPACING, pixel = clamp(at + offset, ivec2(0), last);
      vec2 d = vec2(offset);
      float a = float(picture[uint(pixel.y) * push.size.x + uint(pixel.x)] & 255u) - center;
      float color = a * COLOR;
      float weight = 1.0 / ((1.0 + color * color) * (1.0 + DISTANCE * dot(d, d)));
      vec4 s = clamp(u + ux * d.x + uy * d.y, none, right), r = clamp(v + vx * d.x + vy * d.y, none, low);
      vec4 column = floor(s), row = floor(r), fx = s - column, fy = r - row;
      uvec4 e = uvec4(row) * wide + uvec4(column);
      uvec4 four = uvec4(first[e.x], second[e.y], third[e.z], fourth[e.w]);
      vec4 upper = mix(vec4(four & 255u), vec4((four >> 8u) & 255u), fx);
      vec4 lower = mix(vec4((four >> 16u) & 255u), vec4(four >> 24u), fx);
      vec4 b = mix(upper, lower, fy) - center;
      sum += weight;
      sum_a += weight * a;
      sum_aa += weight * a * a;
      sum_b += weight * b;
      sum_bb += weight * b * b;
      sum_ab += weight * a * b;
    }
  }
  float total = 1.0 / sum, mean_a = sum_a * total;
  vec4 mean_b = sum_b * total;
  // Sums of squares less squares of sums: not below zero but for rounding.
  float variance_a = max(sum_aa * total - mean_a * mean_a, 0.0) + NOISE;
  vec4 variance_b = max(sum_bb * total - mean_b * mean_b, 0.0) + NOISE;
  vec4 covariance = sum_ab * total - mean_b * mean_a;
  vec4 costs = mix(vec4(WORST), 1.0 - covariance / sqrt(variance_a * variance_b), seen);
  vec2 lesser = min(costs.xy, costs.zw), greater = max(costs.xy, costs.zw);
  float best = min(lesser.x, lesser.y);
  float second_best = min(max(lesser.x, lesser.y), lesser.x < lesser.y ? greater.x : greater.y);
  score[t] = push.views == 1u ? best : 0.5 * (best + second_best);
}
