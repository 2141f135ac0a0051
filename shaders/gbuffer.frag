// The depth + normal pass: where the ray of each sample meets the plane of its triangle. The plane comes from the
// triangle's corners (CORNER_PLANES), or from gl_FragCoord.w, which is 1/x in the sector's frame, in full float32, and its
// screen derivatives.
// Out: attachment 0 = 1/x in the sector's frame, its slopes along u and v, echo μ cos θ times range, plus the specular
// lobe of smooth faces (SPECULAR); attachment 1 (BODY_NUMBERS) = number of the body.
// Defines: CORNER_PLANES, SHADING_NORMALS, SPECULAR, BODY_NUMBERS (each 0 or 1).
#version 330 core
#include "plane.glsl"

uniform vec3 u, v;  // lattice: the ray of pixel (i, j) has u.x + u.y i + u.z j as its u, and so for v
uniform float far_m;

#if CORNER_PLANES
flat in vec3 v_plane;
flat in vec2 v_bounds;
#else
uniform mat2 pixel_from_uv; // pixels to one unit of u (first column) and of v (second)
// without a geometry shader they come from the vertex shader
#define v_reflectivity corner_reflectivity
#define v_body corner_body
#define v_lobe corner_lobe
#endif
flat in float v_reflectivity;
flat in uint v_body;
#if SPECULAR
flat in vec2 v_lobe;
#endif
#if SHADING_NORMALS
#if CORNER_PLANES
flat in vec3 v_corner, v_normal;
flat in mat3 v_turn;
#else
in vec3 corner_normal;
#endif
#endif

layout(location = 0) out vec4 plane_echo;
#if BODY_NUMBERS
layout(location = 1) out uint body_id;
#endif

void main()
{
    vec3 pixel = vec3(1.0, gl_FragCoord.xy - 0.5);
    vec2 at = vec2(dot(u, pixel), dot(v, pixel));
    vec3 normal = vec3(0.0);
#if CORNER_PLANES
    vec3 ray = vec3(1.0, -at.x, at.y), plane = v_plane;
    // rounding may put the plane of a thin triangle far beside it
    float depth_inverse = clamp(dot(plane, ray), v_bounds.x, v_bounds.y);
    vec2 slopes = vec2(-plane.y, plane.z);
#if SHADING_NORMALS
    normal = v_normal + v_turn * (ray / depth_inverse - v_corner);
#if SPECULAR
    // the normal over x is linear over the image, as 1/x is
    vec3 column = vec3(0.0, -u.y, v.y), row = vec3(0.0, -u.z, v.z), at_0 = v_normal - v_turn * v_corner;
    vec3 by_column = at_0 * dot(plane, column) + v_turn * column, by_row = at_0 * dot(plane, row) + v_turn * row;
#endif
#endif
#else
    float depth_inverse = gl_FragCoord.w;
    vec2 slopes = vec2(dFdx(depth_inverse), dFdy(depth_inverse)) * pixel_from_uv;
    vec3 plane = plane_of(depth_inverse, slopes, at);
#if SHADING_NORMALS
    normal = corner_normal;
#if SPECULAR
    vec3 over_x = normal * depth_inverse, by_column = dFdx(over_x), by_row = dFdy(over_x);
#endif
#endif
#endif
    float echo = cos_times_range(plane, depth_inverse, at, normal);
    plane_echo = vec4(depth_inverse, slopes, v_reflectivity * echo);
#if SPECULAR
    if (v_lobe.x > 0.0)
#if SHADING_NORMALS
        plane_echo.w += mean_lobe_times_range(echo, depth_inverse, at, v_lobe, normal * depth_inverse, by_column, by_row);
#else
        plane_echo.w += lobe_times_range(echo, depth_inverse, at, v_lobe);
#endif
#endif
#if BODY_NUMBERS
    body_id = v_body + 1u;
#endif
    // linear in x, so that the depth test resolves as much far away as nearby
    gl_FragDepth = 1.0 / (depth_inverse * far_m);
}
