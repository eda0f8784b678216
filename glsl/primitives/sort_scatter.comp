#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#include "thread.glsl"
#include "workgroup_scan.glsl"
// One pass of a stable radix sort: moves every key and its value behind those with a smaller digit, and behind earlier
// ones with the same digit. Counts as `sort_count` does; a scan over the threads turns counts into places.
// variant index: INDEX
layout(constant_id = 0) const uint DIGIT_BITS = 6u; // bits of a digit, 1 to 7
layout(constant_id = 1) const uint ITEMS = 64u;     // keys of a thread, a multiple of 4, at most 1020
const uint PAIRS = 1u << (DIGIT_BITS - 1u);
layout(local_size_x = 64) in;
layout(binding = 0, scalar) readonly buffer Count { uint count[]; };                   // [1] keys
layout(binding = 1, scalar) readonly buffer Before { uint before[]; };                 // [digit, stride] keys with the digit in the blocks before
layout(binding = 2, scalar) readonly buffer Totals { uint totals[]; };                 // [digit] keys with the digit
layout(binding = 3, scalar) readonly buffer Keys { uvec4 keys[]; };                    // [count / 4, rounded up]
layout(binding = 4, scalar) writeonly buffer SortedKeys { uint sorted_keys[]; };       // [count]
layout(binding = 5, scalar) writeonly buffer SortedValues { uint sorted_values[]; };   // [count]
#ifndef INDEX
layout(binding = 6, scalar) readonly buffer Values { uvec4 values[]; };                // [count / 4, rounded up]; in the variant `index` a key's value is its place
#endif
layout(push_constant, scalar) uniform Push {
  uint capacity; // the count is clamped to this
  uint stride;   // blocks that `before` has room for
  uint shift;    // lowest bit of the digit
  uint mask;     // ones where the digit has bits
} push;
shared uint counters[PAIRS * 65u]; // a row of 64 threads per pair of digits, one more against bank conflicts
shared uint places[PAIRS * 2u];    // where the block's first key with the digit goes
void main() {
  uint n = min(count[0], push.capacity);
  uint t = scan_thread();
  uint block = group_index();
  uint first = (block * 64u + t) * ITEMS;
  uint last = min(first + ITEMS, n), shift = push.shift, mask = push.mask;
  for (uint p = 0u; p < PAIRS; ++p) counters[p * 65u + t] = 0u;
  for (uint i = first; i < last; i += 4u) {
    uvec4 digit = (keys[i / 4u] >> shift) & mask;
    for (uint c = 0u; c < 4u; ++c) {
      if (i + c < last) counters[(digit[c] >> 1u) * 65u + t] += 1u << ((digit[c] & 1u) * 16u);
    }
  }
  uint even = t < PAIRS ? totals[2u * t] : 0u;
  uint odd = t < PAIRS ? totals[2u * t + 1u] : 0u;
  uint all;
  uint smaller = exclusive_sum(even + odd, all);
  if (t < PAIRS && block * 64u * ITEMS < n) {
    places[2u * t] = smaller + before[2u * t * push.stride + block];
    places[2u * t + 1u] = smaller + even + before[(2u * t + 1u) * push.stride + block];
    uint running = 0u;
    for (uint i = 0u; i < 64u; ++i) {
      uint own = counters[t * 65u + i];
      counters[t * 65u + i] = running;
      running += own;
    }
  }
  barrier();
  for (uint i = first; i < last; i += 4u) {
    uvec4 key = keys[i / 4u];
    uvec4 digit = (key >> shift) & mask;
#ifdef INDEX
    uvec4 value = i + uvec4(0, 1, 2, 3);
#else
    uvec4 value = values[i / 4u];
#endif
    for (uint c = 0u; c < 4u; ++c) {
      if (i + c >= last) break;
      uint half_word = (digit[c] & 1u) * 16u;
      uint at = (digit[c] >> 1u) * 65u + t;
      uint own = counters[at];
      counters[at] = own + (1u << half_word);
      uint place = places[digit[c]] + ((own >> half_word) & 0xffffu);
      sorted_keys[place] = key[c];
      sorted_values[place] = value[c];
    }
  }
}
