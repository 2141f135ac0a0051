// Per-body and per-face tables, kept in textures of TABLE_WIDTH texels a row (GL 3.3 has no buffers for it).
uniform sampler2D body_table;  // four texels a body: the rows of sonar_from_body; reflectivity
uniform sampler2D face_table;  // one texel a face: reflectivity

vec4 table_texel(sampler2D table, int index)
{
    return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0);
}

mat4x3 body_matrix(uint body)
{
    int first = 4 * int(body);
    vec4 x = table_texel(body_table, first);
    vec4 y = table_texel(body_table, first + 1);
    vec4 z = table_texel(body_table, first + 2);
    return mat4x3(x.x, y.x, z.x, x.y, y.y, z.y, x.z, y.z, z.z, x.w, y.w, z.w);
}

float body_reflectivity(uint body)
{
    return table_texel(body_table, 4 * int(body) + 3).x;
}
