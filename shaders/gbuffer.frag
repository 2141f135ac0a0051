// The depth + normal pass. gl_FragCoord.w is 1/x in the sector's frame, in full float32, and its screen derivatives
// give the plane's slopes, so that depth and normal need no varying.
// Out: attachment 0 = 1/x, its slopes along u and v, echo μ cos θ times range, plus the specular lobe of smooth faces
// (SPECULAR); attachment 1 (LABELS) = number of the body.
// Defines: SHADING_NORMALS, SPECULAR, LABELS (each 0 or 1).
#version 330 core
#include "plane.glsl"

uniform vec3 u, v;          // lattice: the ray of pixel (i, j) has u.x + u.y i + u.z j as its u, and so for v
uniform mat2 pixel_from_uv; // pixels to one unit of u (first column) and of v (second)
uniform float far_m;

flat in float v_reflectivity;
flat in uint v_body;
#if SPECULAR
flat in vec2 v_lobe;
#endif
#if SHADING_NORMALS
in vec3 v_normal;
#else
const vec3 v_normal = vec3(0.0);
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
    float echo = cos_times_range(plane_of(depth_inverse, slopes, at), depth_inverse, at, v_normal);
    plane_echo = vec4(depth_inverse, slopes, v_reflectivity * echo);
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
