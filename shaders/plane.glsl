// The plane that a sample meets, in the sector's frame (x along its middle): p . x = 1, and 1/x is linear on the
// image plane: 1/x = p.x - p.y u + p.z v.
#include "echo.glsl"

// From 1/x on the ray (u, v) = at, and its slopes along u and v.
vec3 plane_of(float depth_inverse, vec2 slopes, vec2 at)
{
    return vec3(depth_inverse - dot(slopes, at), -slopes.x, slopes.y);
}

// cos θ times range; the normal gives cos θ alone, whichever side it is of, or, where it is 0, the plane does.
float cos_times_range(vec3 plane, float depth_inverse, vec2 at, vec3 normal)
{
    if (dot(normal, normal) <= 1e-6)
        return inversesqrt(dot(plane, plane));  // on a flat face the same for every ray
    vec3 ray = vec3(1.0, -at.x, at.y);
    // p . x = 1 > 0: minus p looks at the sonar, whichever side this is
    vec3 turned = normalize(normal) * sign(-dot(normal, plane));
    return cos_incidence(turned, normalize(ray)) * length(ray) / depth_inverse;
}

// The lobe of a smooth face times range, beside the diffuse echo; lobe: its strength and slope.
float lobe_times_range(float cos_times_range, float depth_inverse, vec2 at, vec2 lobe)
{
    float range = length(vec3(1.0, at)) / depth_inverse;
    return specular_lobe(cos_times_range / range, lobe.x, lobe.y) * range;
}
