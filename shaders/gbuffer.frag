// The depth + normal pass: where the ray of each sample meets the plane of its triangle.
// Out: attachment 0 = 1/x in the sector's frame, its slopes along u and v, echo μ cos θ times range, plus the specular
// lobe of smooth faces (SPECULAR); attachment 1 (LABELS) = number of the body.
// Defines: SHADING_NORMALS, SPECULAR, LABELS (each 0 or 1).
#version 330 core
#include "plane.glsl"

uniform vec3 u, v;  // lattice: the ray of pixel (i, j) has u.x + u.y i + u.z j as its u, and so for v
uniform float far_m;

flat in vec3 v_plane;
flat in vec2 v_bounds;
flat in float v_reflectivity;
flat in uint v_body;
#if SPECULAR
flat in vec2 v_lobe;
#endif
#if SHADING_NORMALS
flat in vec3 v_corner, v_normal;
flat in mat3 v_turn;
#endif

layout(location = 0) out vec4 plane_echo;
#if LABELS
layout(location = 1) out uint body_id;
#endif

void main()
{
    vec3 pixel = vec3(1.0, gl_FragCoord.xy - 0.5);
    vec2 at = vec2(dot(u, pixel), dot(v, pixel));
    vec3 ray = vec3(1.0, -at.x, at.y);
    // rounding may put the plane of a thin triangle far beside it
    float depth_inverse = clamp(dot(v_plane, ray), v_bounds.x, v_bounds.y);
#if SHADING_NORMALS
    vec3 normal = v_normal + v_turn * (ray / depth_inverse - v_corner);
#else
    const vec3 normal = vec3(0.0);
#endif
    float echo = cos_times_range(v_plane, depth_inverse, at, normal);
    plane_echo = vec4(depth_inverse, -v_plane.y, v_plane.z, v_reflectivity * echo);
#if SPECULAR
    if (v_lobe.x > 0.0)
        plane_echo.w += lobe_times_range(echo, depth_inverse, at, v_lobe);
#endif
#if LABELS
    body_id = v_body + 1u;
#endif
    // linear in x, so that the depth test resolves as much far away as nearby
    gl_FragDepth = 1.0 / (depth_inverse * far_m);
}
