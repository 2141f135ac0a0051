// Functions of the echo; each has a NumPy twin of the same name in sonar_gl/echo.py.

// Lambert: per steradian the echo is the cosine of incidence, never above 1 or below 0.
float cos_incidence(vec3 normal, vec3 direction)
{
    return clamp(-dot(normal, direction), 0.0, 1.0);
}

// Facets of a smooth surface that look at the sonar (Kirchhoff, high frequency): per steradian, beside μ cos θ.
float specular_lobe(float cos_incidence, float strength, float slope)
{
    float c = clamp(cos_incidence, 1e-3, 1.0);
    float square = c * c;
    float tan_over_slope = (1.0 - square) / (square * slope * slope);
    return strength * exp(-0.5 * tan_over_slope) / (8.0 * slope * slope * square * square * c);
}
