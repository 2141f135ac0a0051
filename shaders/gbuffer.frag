// In: position in the sonar frame, the body's index. Out: attachment 0 = normal (xyz) and range (w),
// attachment 1 = echo μ cos θ and the body's number. Defines: SHADING_NORMALS (0 or 1), TABLE_WIDTH.
#version 330 core
#include "tables.glsl"
#include "echo.glsl"

uniform float far_m;

in vec3 v_position;
flat in uint v_body;
#if SHADING_NORMALS
in vec3 v_normal;
#endif

layout(location = 0) out vec4 normal_range;
layout(location = 1) out vec2 echo_body;

void main()
{
    vec4 face = table_texel(face_table, gl_PrimitiveID);
    float range_m = length(v_position);
    vec3 direction = v_position / range_m;
    vec3 normal = towards_sonar(mat3(body_matrix(v_body)) * face.xyz, direction);
    vec3 shading = normal;
#if SHADING_NORMALS
    if (dot(v_normal, v_normal) > 1e-6)
        shading = normalize(v_normal) * (dot(v_normal, normal) < 0.0 ? -1.0 : 1.0);
#endif
    normal_range = vec4(normal, range_m);
    echo_body = vec2(face.w * cos_incidence(shading, direction), float(v_body) + 1.0);
    // Linear in range, so that visibility is resolved alike near and far.
    gl_FragDepth = range_m / far_m;
}
