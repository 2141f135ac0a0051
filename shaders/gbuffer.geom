// The plane of each triangle and its shading normals, from its corners as they are before the driver clips and snaps
// them. What a driver interpolates, 1/w too, lies between corners that it has moved: by 1/256 of a sample, and to the near
// plane where a triangle reaches behind the sonar.
// In: corners in the sector's frame. Out, one of each to a triangle: plane, bounds of 1/x, shading normal as it changes
// with the place, reflectivity, body, lobe.
// Defines: SHADING_NORMALS, SPECULAR (each 0 or 1).
#version 330 core
layout(triangles) in;
layout(triangle_strip, max_vertices = 3) out;

// Square of 2^-21: where the height of a triangle is less of its distance, rounding of its corners decides its plane.
const float SLIVER = 2.3e-13;

in vec3 corner[];
flat in float corner_reflectivity[];
flat in uint corner_body[];
flat out vec3 v_plane;  // p . x = 1 for all points x on it
flat out vec2 v_bounds; // of 1/x between the corners
flat out float v_reflectivity;
flat out uint v_body;
#if SPECULAR
flat in vec2 corner_lobe[];
flat out vec2 v_lobe;
#endif
#if SHADING_NORMALS
in vec3 corner_normal[];
flat out vec3 v_corner, v_normal;
flat out mat3 v_turn;  // shading normal at x = v_normal + v_turn (x - v_corner)
#endif

float square(vec3 v)
{
    return dot(v, v);
}

void main()
{
    vec3 a = corner[0], b = corner[1], c = corner[2];
    vec3 normal = cross(b - a, c - a);
    float distance = dot(normal, a);
    float longest = max(max(square(b - a), square(c - b)), square(a - c));
    float furthest = max(max(square(a), square(b)), square(c));
    if (square(normal) <= SLIVER * longest * furthest || distance == 0.0)
        return; // the latter is seen edge on
    float nearest_x = min(min(a.x, b.x), c.x), furthest_x = max(max(a.x, b.x), c.x);
    vec2 bounds = nearest_x > 0.0 ? 1.0 / vec2(furthest_x, nearest_x) : vec2(0.0, 1e30);
#if SHADING_NORMALS
    vec3 along_b = cross(c - a, normal) / square(normal), along_c = cross(normal, b - a) / square(normal);
    mat3 turn = outerProduct(corner_normal[1] - corner_normal[0], along_b);
    turn += outerProduct(corner_normal[2] - corner_normal[0], along_c);
#endif
    for (int k = 0; k < 3; k++) {
        gl_Position = gl_in[k].gl_Position;
        gl_ClipDistance[0] = gl_in[k].gl_ClipDistance[0];
        v_plane = normal / distance;
        v_bounds = bounds;
        v_reflectivity = corner_reflectivity[0];
        v_body = corner_body[0];
#if SPECULAR
        v_lobe = corner_lobe[0];
#endif
#if SHADING_NORMALS
        v_corner = a;
        v_normal = corner_normal[0];
        v_turn = turn;
#endif
        EmitVertex();
    }
}
