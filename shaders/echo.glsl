// Functions of the echo; each has a NumPy twin of the same name in sonar_gl/acoustics.py.

// The normal turned to the side that the sonar sees; both sides of an open mesh echo.
vec3 towards_sonar(vec3 normal, vec3 direction)
{
    return dot(normal, direction) > 0.0 ? -normal : normal;
}

// Lambert: per steradian the echo is the cosine of incidence, never above 1 or below 0.
float cos_incidence(vec3 normal, vec3 direction)
{
    return clamp(-dot(normal, direction), 0.0, 1.0);
}
