// The plane p that a sample meets, in the sector's frame (x along its axis): p . x = 1 for all points x on it. 1/x is
// linear on the image plane: 1/x = p.x - p.y u + p.z v.
#include "echo.glsl"

// The plane, from 1/x on the ray (u, v) = at and the slopes of 1/x along u and v.
vec3 plane_of(float depth_inverse, vec2 slopes, vec2 at)
{
    return vec3(depth_inverse - dot(slopes, at), -slopes.x, slopes.y);
}

// cos θ times range. The normal is a shading normal of any length and either side, which replaces that of the plane in
// cos θ; vec3(0) for none.
float cos_times_range(vec3 plane, float depth_inverse, vec2 at, vec3 normal)
{
    vec3 size = abs(normal);
    float largest = max(max(size.x, size.y), size.z);
    if (largest == 0.0)
        return inversesqrt(dot(plane, plane));  // the distance of the plane, which all rays share
    vec3 ray = vec3(1.0, -at.x, at.y);
    // Squares of very long normals would overflow, those of very short ones vanish. 2^-80 and 2^100 round nothing.
    normal *= largest > 1e12 ? 8.2718061e-25 : largest < 1e-12 ? 1.2676506e30 : 1.0;
    // p . x = 1 > 0, so that -p points to the side of the sonar
    vec3 turned = normalize(normal) * sign(-dot(normal, plane));
    return cos_incidence(turned, normalize(ray)) * length(ray) / depth_inverse;
}

// Specular lobe times range, which adds to the diffuse echo. lobe: its strength and slope.
float lobe_times_range(float cos_times_range, float depth_inverse, vec2 at, vec2 lobe)
{
    float range = length(vec3(1.0, at)) / depth_inverse;
    return specular_lobe(cos_times_range / range, lobe.x, lobe.y) * range;
}
