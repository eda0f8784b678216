#version 460
#extension GL_EXT_scalar_block_layout : require
// A count against the capacity that was allocated for it. A count that does not fit becomes 0 and raises the sticky
// overflow flag: the optimiser then skips steps until the host has grown the buffers.
layout(local_size_x = 1) in;
layout(binding = 0, scalar) readonly buffer Wanted { uint wanted[]; };   // [1] what there is
layout(binding = 1, scalar) writeonly buffer Count { uint count[]; };    // [1] the same, or 0
layout(binding = 2, scalar) buffer Overflow { uint overflow[]; };        // [1] one bit per limit, never cleared here
layout(binding = 3, scalar) writeonly buffer Counters { uint counters[]; }; // [counter] what there was, for the host
layout(push_constant, scalar) uniform Push {
  uint capacity; // most that fits
  uint bit;      // which bit of the flag
  uint counter;  // where in the counters
} push;
void main() {
  bool fits = wanted[0] <= push.capacity;
  count[0] = fits ? wanted[0] : 0u;
  if (!fits) overflow[0] |= 1u << push.bit;
  counters[push.counter] = wanted[0];
}
