#version 460
#extension GL_EXT_scalar_block_layout : require
// Whether the optimiser must leave the attention's weights alone: an overflow, or no tokens in this step.
layout(local_size_x = 1) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Overflow { uint overflow[]; };  // [1] sticky flag of the step
layout(binding = 2, scalar) writeonly buffer Skip { uint skip[]; };         // [1] 1: skip
void main() { skip[0] = overflow[0] != 0u || tokens[0] == 0u || tokens[1] == 0u ? 1u : 0u; }
