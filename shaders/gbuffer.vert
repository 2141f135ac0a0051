// In: vertices in their body's frame, the body's index. Out: clip position, reflectivity, body.
// Defines: SHADING_NORMALS, FACE_REFLECTIVITY, LABELS (each 0 or 1), TABLE_WIDTH.
#version 330 core
#include "tables.glsl"

uniform mat4 clip_from_sonar;
uniform mat3 sector_from_sonar;

in vec3 in_position;
in uint in_body;
#if SHADING_NORMALS
in vec3 in_normal;
out vec3 v_normal;
#endif
flat out float v_reflectivity;
flat out uint v_body;

void main()
{
    mat4x3 sonar_from_body = body_matrix(in_body);
    v_reflectivity = body_reflectivity(in_body);
    v_body = in_body;
#if SHADING_NORMALS
    v_normal = sector_from_sonar * (mat3(sonar_from_body) * in_normal);
#endif
    gl_Position = clip_from_sonar * vec4(sonar_from_body * vec4(in_position, 1.0), 1.0);
}
