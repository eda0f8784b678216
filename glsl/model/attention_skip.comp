#version 460
#extension GL_EXT_scalar_block_layout : require
// Whether the optimiser must leave the attention's weights alone: an overflow, or no tokens in this step. And the
// tokens whose features may be written back: after an overflow the step is taken again, so none.
layout(local_size_x = 1) in;
layout(binding = 0, scalar) readonly buffer Tokens { uint tokens[]; };      // [2] tokens inside, around
layout(binding = 1, scalar) readonly buffer Overflow { uint overflow[]; };  // [1] sticky flag of the step
layout(binding = 2, scalar) writeonly buffer Skip { uint skip[]; };         // [3] 1: skip; tokens to write back inside, around
void main() {
  bool over = overflow[0] != 0u;
  skip[0] = over || tokens[0] == 0u || tokens[1] == 0u ? 1u : 0u;
  skip[1] = over ? 0u : tokens[0];
  skip[2] = over ? 0u : tokens[1];
}
