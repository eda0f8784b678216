#version 460
#extension GL_EXT_scalar_block_layout : require
// A dispatch that does nothing but look at its push constants, unless there is something to write.
layout(local_size_x = 64) in;
layout(binding = 0, scalar) buffer Word { uint word[]; }; // [1]
layout(push_constant, scalar) uniform Push {
  uint add; // to the word; 0 leaves it alone
} push;
void main() {
  if (push.add != 0u && gl_LocalInvocationID.x == 0u) word[0] += push.add;
}
