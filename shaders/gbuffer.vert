// In: vertices in their body's frame, the body's index. Out: position in the sonar frame, clip position.
// Defines: SHADING_NORMALS (0 or 1), TABLE_WIDTH.
#version 330 core
#include "tables.glsl"

uniform mat4 clip_from_sonar;

in vec3 in_position;
in uint in_body;
#if SHADING_NORMALS
in vec3 in_normal;
out vec3 v_normal;
#endif
out vec3 v_position;
flat out uint v_body;

void main()
{
    mat4x3 sonar_from_body = body_matrix(in_body);
    v_position = sonar_from_body * vec4(in_position, 1.0);
    v_body = in_body;
#if SHADING_NORMALS
    v_normal = mat3(sonar_from_body) * in_normal;
#endif
    gl_Position = clip_from_sonar * vec4(v_position, 1.0);
}
