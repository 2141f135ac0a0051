// For the fragment shader of a host that draws a sonar's sectors: declares two outputs, which `sonar_gl_write` writes.
// The vertex shader's gl_Position must be `projection * view * world position`, with the matrices of the sector.
// Outputs 0 and 1 are used; all names begin with sonar_gl_.
#define cos_incidence sonar_gl_cos_incidence
#define specular_lobe sonar_gl_specular_lobe
#define plane_of sonar_gl_plane_of
#define cos_times_range sonar_gl_cos_times_range
#define lobe_times_range sonar_gl_lobe_times_range
#define mean_lobe_times_range sonar_gl_mean_lobe_times_range
#define BLUR SONAR_GL_BLUR
#define MAX_TURN SONAR_GL_MAX_TURN
#include "plane.glsl"

uniform mat3 sonar_gl_lattice;  // of the sector: maps a pixel (1, i, j) to the u and v of its ray, and 1 / far

layout(location = 0) out vec4 sonar_gl_plane_echo;
layout(location = 1) out uint sonar_gl_body;

// Whether a number is neither NaN nor infinite. Comparisons do not tell: GLSL leaves open what they give for NaN.
bool sonar_gl_is_finite(float number)
{
    return (floatBitsToUint(number) & 0x7F800000u) != 0x7F800000u;
}

bool sonar_gl_is_within(float number, float low, float high)
{
    return sonar_gl_is_finite(number) && number >= low && number <= high;
}

// normal: in the view's axes (x right, y up, z back), of any length; vec3(0) takes that of the flat face
// reflectivity: μ, 0..1
// body: number of the body, 1..65534; 0 for none
// lobe: |R|², 0..1, and rms slope, 0.01..0.5, of a smooth face; vec2(0) for none
void sonar_gl_write(vec3 normal, float reflectivity, uint body, vec2 lobe)
{
    float depth_inverse = gl_FragCoord.w;
    vec3 at = sonar_gl_lattice * vec3(1.0, gl_FragCoord.xy - 0.5);
    mat2 pixel_from_uv = inverse(mat2(sonar_gl_lattice[1].xy, sonar_gl_lattice[2].xy));
    vec2 slopes = vec2(dFdx(depth_inverse), dFdy(depth_inverse)) * pixel_from_uv;
    vec3 turned = vec3(-normal.z, -normal.x, normal.y);  // x ahead, y to port, z up
    vec3 over_x = turned * depth_inverse, by_column = dFdx(over_x), by_row = dFdy(over_x);
    float echo = cos_times_range(plane_of(depth_inverse, slopes, at.xy), depth_inverse, at.xy, turned);
    sonar_gl_plane_echo = vec4(depth_inverse, slopes, reflectivity * echo);
    // No echo is negative: these numbers tell Framebuffer.read what is wrong.
    if (!sonar_gl_is_within(reflectivity, 0.0, 1.0))
        sonar_gl_plane_echo.w = -1.0;
    else if (!(sonar_gl_is_finite(normal.x) && sonar_gl_is_finite(normal.y) && sonar_gl_is_finite(normal.z)))
        sonar_gl_plane_echo.w = -2.0;
    else if (!(lobe.x == 0.0 || sonar_gl_is_within(lobe.x, 0.0, 1.0) && sonar_gl_is_within(lobe.y, 0.01, 0.5)))
        sonar_gl_plane_echo.w = -3.0;
    else if (lobe.x > 0.0)
        sonar_gl_plane_echo.w += mean_lobe_times_range(echo, depth_inverse, at.xy, lobe, over_x, by_column, by_row);
    sonar_gl_body = min(body, 65535u);
    gl_FragDepth = at.z / depth_inverse;
}

void sonar_gl_write(vec3 normal, float reflectivity, uint body)
{
    sonar_gl_write(normal, reflectivity, body, vec2(0.0));
}

#undef cos_incidence
#undef specular_lobe
#undef plane_of
#undef cos_times_range
#undef lobe_times_range
#undef mean_lobe_times_range
#undef BLUR
#undef MAX_TURN
