// Functions of the echo; each has a NumPy twin of the same name in sonar_gl/reference.py.

// Lambert: per steradian the echo is the cosine of incidence, never above 1 or below 0.
float cos_incidence(vec3 normal, vec3 direction)
{
    return clamp(-dot(normal, direction), 0.0, 1.0);
}
