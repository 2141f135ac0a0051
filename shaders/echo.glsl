// Backscatter of a surface. Each function has a NumPy twin of the same name in sonar_gl/acoustics/boundary.py.

// Cosine of the angle of incidence, in 0..1: Lambert backscatter per steradian of a surface of reflectivity 1.
float cos_incidence(vec3 normal, vec3 direction)
{
    return clamp(-dot(normal, direction), 0.0, 1.0);
}

// Specular lobe of a smooth surface per steradian, which adds to the Lambert backscatter μ cos θ: the facets that face
// the sonar (Kirchhoff approximation, high frequency). strength: |R|²; slope: rms slope of the facets.
float specular_lobe(float cos_incidence, float strength, float slope)
{
    float c = clamp(cos_incidence, 1e-3, 1.0);
    float square = c * c;
    float tan_over_slope = (1.0 - square) / (square * slope * slope);
    return strength * exp(-0.5 * tan_over_slope) / (8.0 * slope * slope * square * square * c);
}
