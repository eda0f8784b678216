// Layouts of the decoder's scratch (include model.glsl before). Everything is read four values at a time, so rows are
// padded: an input to 40 values (the 37th is 1, for the bias), the outputs of each head to a multiple of 8.
const uint HEADS = 3u;             // opacity, color, cov
const uint INPUT_VEC4 = 10u;       // vec4s of a padded input
const uint HIDDEN_VEC4 = 24u;      // vec4s of the hidden units of the three heads
const uint POSITIVE = 6u;          // words of their signs
const uint ROW_VEC4 = 8u;          // vec4s of one head's hidden units: a row of the second layer
const uint FIRST_WEIGHTS = HIDDEN * INPUT + HIDDEN; // of one head, biases included
const uint FIRST_VEC4 = HEADS * HIDDEN * INPUT_VEC4; // packed first layer; the second one follows, then its biases
const uint UNITS = 16u;            // units or features of a thread
const uint UNITS_VEC4 = UNITS / 4u;
const uint OPACITIES = 5u;         // of an anchor in a thread
const uint SECOND_VEC4 = 91u;      // vec4s of one Gaussian's second layer: 11 rows, 11 biases
const uint SECOND_THREADS = 88u;   // threads of its gradient in the form for GPUs: 11 rows of 8 vec4s
const uint LANES_ANCHORS = 64u; // anchors of a subgroup of 8 in the forms of lanes
const uint BLOCK = 64u;            // anchors of the smallest chunk of the first layer's weight gradient, Gaussians of the second's
const uint CHUNKS = 1024u;         // chunks of the first layer's at most
const uint SECOND_CHUNKS = 8192u;  // chunks of the second layer's at most, and one for each k

uint padded(uint n) { return (n + 7u) & ~7u; }
// Outputs per Gaussian: 1, 3, 7; of the heads before: 0, 1, 4.
uint per_gaussian(uint head) { return (2u << head) - 1u; }
uint per_gaussian_before(uint head) { return (2u << head) - 2u - head; }
// First weight of a head in the model's flat array.
uint head_weights(uint head, uint offsets) {
  return head * FIRST_WEIGHTS + (HIDDEN + 1u) * per_gaussian_before(head) * offsets;
}
// First padded output row of a head; of head 3: the number of rows.
uint head_row(uint head, uint offsets) {
  return (head > 0u ? padded(offsets) : 0u) + (head > 1u ? padded(3u * offsets) : 0u) + (head > 2u ? padded(7u * offsets) : 0u);
}
// vec4s of all packed weights: first layer with its biases, second layer, its biases.
uint packed_weights(uint offsets) { return FIRST_VEC4 + head_row(3u, offsets) * (ROW_VEC4 * 4u + 1u) / 4u; }
const uint PADDING = ~0u;
// The model's weight at component c of packed vec4 i; PADDING where there is none.
uint weight_at(uint i, uint c, uint offsets) {
  if (i < FIRST_VEC4) {
    uint unit = i / INPUT_VEC4, column = 4u * (i % INPUT_VEC4) + c, from = head_weights(unit / HIDDEN, offsets);
    unit %= HIDDEN;
    return column > INPUT ? PADDING : from + (column < INPUT ? unit * INPUT + column : HIDDEN * INPUT + unit);
  }
  i -= FIRST_VEC4;
  uint rows = head_row(3u, offsets);
  bool matrix = i < rows * ROW_VEC4;
  uint row = matrix ? i / ROW_VEC4 : 4u * (i - rows * ROW_VEC4) + c;
  uint head = row < head_row(1u, offsets) ? 0u : row < head_row(2u, offsets) ? 1u : 2u;
  uint outputs = per_gaussian(head) * offsets, from = head_weights(head, offsets) + FIRST_WEIGHTS;
  row -= head_row(head, offsets);
  return row >= outputs ? PADDING : from + (matrix ? row * HIDDEN + 4u * (i % ROW_VEC4) + c : outputs * HIDDEN + row);
}
// Which run of `run` entries of the list of decoded Gaussians a thread has: those of each k make runs of their own.
// `segments` as of decode_lists; `begin == end` where there is none.
#define RUN_OF(t, run, k, begin, end) \
  uint k = 0u, begin = 0u, end = 0u; \
  for (uint left = t, i = 0u; i < OFFSETS; ++i) { \
    uint at = segments[i], next = segments[i + 1u], runs = (next - at + run - 1u) / run; \
    if (left < runs) { \
      k = i; \
      begin = at + left * run; \
      end = min(begin + run, next); \
    } \
    left = left < runs ? ~0u : left - runs; \
  }
// Anchors of one chunk of a weight gradient.
uint chunk_anchors(uint anchors) { return BLOCK * max(1u, (anchors + BLOCK * CHUNKS - 1u) / (BLOCK * CHUNKS)); }

// Listed Gaussians of one chunk.
uint chunk_listed(uint listed) { return BLOCK * max(1u, (listed + BLOCK * SECOND_CHUNKS - 1u) / (BLOCK * SECOND_CHUNKS)); }

// Which of the hidden units of a run of 16 are positive, a bit for each: of the q-th vec4.
uint positive_bits(vec4 h, uint q) {
  uvec4 bits = mix(uvec4(0u), uvec4(1u, 2u, 4u, 8u) << 4u * q, greaterThan(h, vec4(0.0)));
  return bits.x | bits.y | bits.z | bits.w;
}
bvec4 positive_at(uint bits, uint q) { return notEqual(uvec4(bits) & (uvec4(1u, 2u, 4u, 8u) << 4u * q), uvec4(0u)); }

float dot_add(float sum, vec4 a, vec4 b) { return fma(a.w, b.w, fma(a.z, b.z, fma(a.y, b.y, fma(a.x, b.x, sum)))); }
vec4 add_scaled(vec4 sum, float a, vec4 b) { return fma(vec4(a), b, sum); }

float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); } // exp may overflow: 1 / inf = 0
// Without the overflow of exp(x) in some drivers' tanh, and without cancellation near 0.
float tanh_safe(float x) {
  float t = exp(-2.0 * abs(x)), s = x * x;
  float small = x * (1.0 + s * (-1.0 / 3.0 + s * (2.0 / 15.0 - s * (17.0 / 315.0))));
  return abs(x) < 0.1 ? small : sign(x) * (1.0 - t) / (1.0 + t);
}
// Beyond the logarithm of the largest float there is no exponential: the largest float, so that an offset or a gradient
// of 0 times it is 0. A Gaussian of that size is absent (`project`). Not-a-number stays what it is.
const float EXP_LIMIT = 88.72283;
const float MAX_FLOAT = 3.4028234663852886e38;
vec3 exp_saturated(vec3 x) { return mix(exp(x), vec3(MAX_FLOAT), greaterThan(x, vec3(EXP_LIMIT))); }
// Length without overflow of the squares. Their underflow, below 1e-19, is of lengths that count as zero.
float norm_of(vec4 q) {
  float largest = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
  return largest > 1e18 ? largest * length(q / largest) : length(q);
}
