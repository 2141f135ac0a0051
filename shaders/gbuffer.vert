// In: vertices relative to the centre of their mesh; a row of the table of bodies, per instance, or as uniforms if the
// driver has no indirect draws. Out: clip position, place in the sector's frame, reflectivity, body, lobe.
// Defines: SHADING_NORMALS, FACE_REFLECTIVITY, SPECULAR, INDIRECT (each 0 or 1).
#version 330 core
#if INDIRECT
#define PER_BODY in
#else
#define PER_BODY uniform
#endif

uniform mat4 clip_from_sonar;
uniform mat3 sector_from_sonar;
uniform vec4 before;  // clip plane, if enabled: cuts what has before . (x, y, z, 1) < 0

out float gl_ClipDistance[1];
out vec3 corner;

PER_BODY vec4 body_x, body_y, body_z;  // rows of sonar_from_body
PER_BODY vec4 body_echo;               // reflectivity; number, exact below 2^24; strength and slope of the lobe

in vec3 in_position;
#if SHADING_NORMALS
in vec3 in_normal;
out vec3 corner_normal;
#endif
#if FACE_REFLECTIVITY
in float in_reflectivity;
#endif
flat out float corner_reflectivity;
flat out uint corner_body;
#if SPECULAR
flat out vec2 corner_lobe;
#endif

void main()
{
    corner_reflectivity = body_echo.x;
    corner_body = uint(body_echo.y);
#if SPECULAR
    corner_lobe = body_echo.zw;
#endif
#if FACE_REFLECTIVITY
    corner_reflectivity *= in_reflectivity;
#endif
    vec4 p = vec4(in_position, 1.0);
    vec4 in_sonar = vec4(dot(body_x, p), dot(body_y, p), dot(body_z, p), 1.0);
#if SHADING_NORMALS
    vec3 n = in_normal;
    corner_normal = sector_from_sonar * vec3(dot(body_x.xyz, n), dot(body_y.xyz, n), dot(body_z.xyz, n));
#endif
    corner = sector_from_sonar * in_sonar.xyz;
    gl_Position = clip_from_sonar * in_sonar;
    gl_ClipDistance[0] = dot(before, in_sonar);
}
