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

// The same about a sample whose shading normal turns: widened to BLUR samples², which turns normals by no more than
// MAX_TURN radians². Its twin in the engine cpu derives it.
// normal: over x, on the ray; by_column, by_row: how that changes from sample to sample. vec3(0) for none
const float BLUR = 0.25, MAX_TURN = 0.1;

float mean_lobe_times_range(
    float cos_times_range, float depth_inverse, vec2 at, vec2 lobe, vec3 normal, vec3 by_column, vec3 by_row)
{
    vec3 size = abs(normal);
    float largest = max(max(size.x, size.y), size.z);
    if (largest == 0.0)
        return lobe_times_range(cos_times_range, depth_inverse, at, lobe);
    // Squares of very long normals would overflow, those of very short ones vanish
    float unit = 1.0 / max(largest, 1e-37);
    vec3 m = normal * unit, a = by_column * unit, b = by_row * unit, d = normalize(vec3(1.0, -at.x, at.y));
    float square = dot(m, m), range = length(vec3(1.0, at)) / depth_inverse;
    vec3 across_a = a - dot(a, m) / square * m, across_b = b - dot(b, m) / square * m;
    vec2 along_ray = vec2(dot(across_a, d), dot(across_b, d));
    vec2 turn = (vec2(dot(across_a, across_a), dot(across_b, across_b)) - along_ray * along_ray) / square;
    vec2 triples = vec2(dot(d, cross(m, a)), dot(d, cross(m, b))) / square;
    float c = clamp(cos_times_range / range, 1e-3, 1.0), c2 = c * c, s2 = lobe.y * lobe.y;
    vec2 blur = max(BLUR - s2 / max(turn, 1e-30), 0.0);
    blur *= min(1.0, MAX_TURN / max(dot(blur, turn), 1e-30));
    float both = dot(m, cross(a, b)) * c / (square * sqrt(square));
    float determinant = s2 * (s2 + dot(blur, turn)) + blur.x * blur.y * both * both;
    float exponent = -0.5 * (s2 * (1.0 - c2) + dot(blur, triples * triples)) / (c2 * determinant);
    return lobe.x * exp(exponent) / (8.0 * sqrt(determinant) * c2 * c2 * c) * range;
}
