#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
// As decode_backward_first, for subgroups of 8 (CPU drivers): a subgroup takes a chunk, 12 units in a lane, and of the
// inputs each lane loads an eighth.
layout(local_size_x = 8) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Inputs { vec4 inputs[]; };          // [V*10] of decode_input
layout(binding = 2, scalar) readonly buffer GradHidden { vec4 grad_hidden[]; }; // [V*24] of decode_backward_hidden
layout(binding = 3, scalar) writeonly buffer Partial { vec4 partial[]; };       // [chunk*96*10] like the packed first layer
void main() {
  const uint ROWS = HIDDEN_VEC4 / 8u;
  uint lane = gl_SubgroupInvocationID, n = groups[3], chunk = chunk_anchors(n), part = group_index();
  if (part * chunk >= n) return;
  vec4 sum[4u * ROWS * INPUT_VEC4];
  [[unroll]] for (uint i = 0u; i < 4u * ROWS * INPUT_VEC4; ++i) sum[i] = vec4(0.0);
  uint end = min(n, (part + 1u) * chunk);
  for (uint v = part * chunk; v < end; ++v) {
    vec4 most = inputs[v * INPUT_VEC4 + lane], rest = inputs[v * INPUT_VEC4 + 8u + lane % 2u], g[ROWS];
    [[unroll]] for (uint r = 0u; r < ROWS; ++r) g[r] = grad_hidden[v * HIDDEN_VEC4 + ROWS * lane + r];
    [[unroll]] for (uint i = 0u; i < INPUT_VEC4; ++i) {
      vec4 x = i < 8u ? subgroupShuffle(most, i) : subgroupShuffle(rest, i - 8u);
      [[unroll]] for (uint u = 0u; u < 4u * ROWS; ++u)
        sum[u * INPUT_VEC4 + i] = add_scaled(sum[u * INPUT_VEC4 + i], g[u / 4u][u % 4u], x);
    }
  }
  uint to = part * FIRST_VEC4 + 4u * ROWS * lane * INPUT_VEC4;
  [[unroll]] for (uint i = 0u; i < 4u * ROWS * INPUT_VEC4; ++i) partial[to + i] = sum[i];
}
