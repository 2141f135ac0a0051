// The depth + normal pass. A surface's plane in the sector's frame (x along its middle) is p . x = 1, and
// 1/x is linear on the image plane: 1/x = p.x - p.y u + p.z v. gl_FragCoord.w is that 1/x, in full float32,
// and its screen derivatives are the plane's slopes, so depth and normal come without a varying.
// Out: attachment 0 = 1/x, its slopes along u and v, echo μ cos θ times range (which on a flat face is the same
// for every ray, μ / |p|), with the lobes of smooth faces (SPECULAR); attachment 1 (LABELS) = body's number.
// Defines: SHADING_NORMALS, SPECULAR, LABELS (each 0 or 1).
#version 330 core
#include "echo.glsl"

uniform vec3 u, v;          // lattice: u of the ray of pixel (i, j) is u.x + u.y i + u.z j; v likewise
uniform mat2 pixel_from_uv; // pixels to one unit of u (first column) and of v (second)
uniform float far_m;

flat in float v_reflectivity;
flat in uint v_body;
#if SPECULAR
flat in vec2 v_lobe;
#endif
#if SHADING_NORMALS
in vec3 v_normal;
#endif

layout(location = 0) out vec4 plane_echo;
#if LABELS
layout(location = 1) out uint body_id;
#endif

void main()
{
    float depth_inverse = gl_FragCoord.w;
    vec2 slopes = vec2(dFdx(depth_inverse), dFdy(depth_inverse)) * pixel_from_uv;
    vec3 pixel = vec3(1.0, gl_FragCoord.xy - 0.5);
    vec2 at = vec2(dot(u, pixel), dot(v, pixel));
    vec3 plane = vec3(depth_inverse - dot(slopes, at), -slopes.x, slopes.y);
    float x = 1.0 / depth_inverse;
    float echo = inversesqrt(dot(plane, plane));
#if SHADING_NORMALS || SPECULAR
    vec3 ray = vec3(1.0, -at.x, at.y);
    float range = length(ray) * x;
#endif
#if SHADING_NORMALS
    // p . x = 1 > 0: minus p looks at the sonar, whichever side this is
    if (dot(v_normal, v_normal) > 1e-6)
        echo = cos_incidence(normalize(v_normal) * sign(-dot(v_normal, plane)), normalize(ray)) * range;
#endif
    plane_echo = vec4(depth_inverse, slopes, v_reflectivity * echo);
#if SPECULAR
    if (v_lobe.x > 0.0)
        plane_echo.w += specular_lobe(echo / range, v_lobe.x, v_lobe.y) * range;
#endif
#if LABELS
    body_id = v_body + 1u;
#endif
    // linear in x, so that visibility is resolved alike near and far
    gl_FragDepth = x / far_m;
}
