// Logits and other products of 32 own by 32 other tokens of one head, in a workgroup of 128 threads: thread 16 r + c has own
// tokens 4 r to 4 r + 3 with others c and c + 16. Operands pass through shared memory 8 of the 64 terms at a time, so that a
// term passes through at most 8 additions within its run and 8 behind it; every pass that forms a logit forms the same.
const uint TILE = 32u; // tokens of either side
const uint RUN = 8u;   // terms
const uint STRIDE = TILE / 4u + 1u; // vec4s of a row of shared memory: one more than it has
const float LOWEST = -3e38; // below every logit; its exponential is 0
shared vec4 run_own[RUN * HEAD];   // own tokens by term; or 8 other tokens' vectors
shared vec4 run_other[RUN * HEAD]; // other tokens by term; or 8 other tokens' vectors
#define own_row() (gl_LocalInvocationID.x / 16u)
#define other_column() (gl_LocalInvocationID.x % 16u)
// A run's four terms of one own or other token.
void put_terms(bool own, uint token, uint quad, vec4 x) {
  [[unroll]] for (uint c = 0u; c < 4u; ++c) {
    uint at = (4u * quad + c) * STRIDE + token / 4u;
    if (own) run_own[at][token % 4u] = x[c];
    else run_other[at][token % 4u] = x[c];
  }
}
// result[i] += the products of the terms that lie there, of the i-th of the thread's others.
void add_run(inout vec4 result[2]) {
  uint row = own_row(), column = other_column();
  vec4 part[2] = vec4[2](vec4(0.0), vec4(0.0));
  [[unroll]] for (uint k = 0u; k < RUN; ++k) {
    vec4 a = run_own[k * STRIDE + row];
    uint at = k * STRIDE + column / 4u;
    part[0] = fma(a, vec4(run_other[at][column % 4u]), part[0]);
    part[1] = fma(a, vec4(run_other[at + 4u][column % 4u]), part[1]);
  }
  result[0] += part[0];
  result[1] += part[1];
}
// The products of rows of `mine` from token `own` on with rows of `theirs` from token `other` on, clamped to the last tokens:
// arrays of tokens' vec4s, of which `head` is the head's first.
#define TILE_PRODUCTS(result, mine, own, last_own, theirs, other, last_other, head) \
  result[0] = result[1] = vec4(0.0); \
  for (uint term = 0u; term < HEAD; term += 2u) { \
    uint half_ = gl_LocalInvocationID.x % 64u, token = half_ / 2u, quad = half_ % 2u, at = head + term + quad; \
    barrier(); \
    if (gl_LocalInvocationID.x < 64u) put_terms(true, token, quad, mine[min(own + token, last_own) * INNER + at]); \
    else put_terms(false, token, quad, theirs[min(other + token, last_other) * INNER + at]); \
    barrier(); \
    add_run(result); \
  }
