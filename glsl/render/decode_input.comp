#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The decoder's input of every visible anchor: feature, unit view direction, distance, 1.
layout(local_size_x = 64) in;
#include "thread.glsl"
#include "model.glsl"
#include "decoder.glsl"
#include "camera.glsl"
layout(binding = 0, scalar) readonly buffer Groups { uint groups[]; };  // [4] x, y, z of the dispatch; visible anchors
layout(binding = 1, scalar) readonly buffer Visible { uint visible[]; };    // [V] anchors
layout(binding = 2, scalar) readonly buffer Position { vec3 position[]; };  // [N] world
layout(binding = 3, scalar) readonly buffer Feature { float feature[]; };   // [N*32]
layout(binding = 4, scalar) writeonly buffer Inputs { vec4 inputs[]; };     // [V*10] feature 32, direction 3, distance, 1, zeros
layout(push_constant, scalar) uniform Push {
  vec3 center;     // of the camera, world, rounded
  vec3 center_low; // the rest of it
} push;
void main() {
  uint v = thread_index();
  if (v >= groups[3]) return;
  uint anchor = visible[v], to = v * INPUT_VEC4;
  for (uint i = 0u; i < FEATURE / 4u; ++i) {
    uint f = anchor * FEATURE + 4u * i;
    inputs[to + i] = vec4(feature[f], feature[f + 1u], feature[f + 2u], feature[f + 3u]);
  }
  vec3 view = from_center(position[anchor], push.center, push.center_low);
  float distance = length(view);
  // A camera on an anchor has no direction.
  inputs[to + 8u] = distance > 0.0 ? vec4(view / distance, distance) : vec4(0.0);
  inputs[to + 9u] = vec4(1.0, 0.0, 0.0, 0.0);
}
