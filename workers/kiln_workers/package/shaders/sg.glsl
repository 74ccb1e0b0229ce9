// Spherical Gaussians and the glossy lobe they are convolved with. GLSL ES 3.00; no uniforms, no samplers.
//
// Source: Currius et al. 2020, "Spherical Gaussian Light-field Textures for Fast Precomputed Global Illumination",
// section 6 and appendix B; equation numbers below are theirs. Equations 20 and 23 to 24 do not hold as printed; the
// forms here are corrected (Xu et al. 2013, "Anisotropic Spherical Gaussians", eq. 8 and 22).

const float LK_PI = 3.14159265358979;

// G(v) = amplitude exp(sharpness (v.axis - 1)).
struct LkLobe {
  vec3 axis;
  float sharpness;
  vec3 amplitude;
};

// amplitude max(v.z, 0) exp(-sharpness.x (v.x)^2 - sharpness.y (v.y)^2) in the frame x, y, z.
struct LkAnisotropicLobe {
  vec3 x;
  vec3 y;
  vec3 z;
  vec2 sharpness;
  float amplitude;
};

// Evaluate a lobe in the unit direction v (eq. 1).
vec3 lkEvaluate(LkLobe lobe, vec3 v) {
  return lobe.amplitude * exp(lobe.sharpness * (dot(v, lobe.axis) - 1.0));
}

// Evaluate an anisotropic lobe in the unit direction v (eq. 20 with squared dot products).
float lkEvaluate(LkAnisotropicLobe lobe, vec3 v) {
  float x = dot(v, lobe.x);
  float y = dot(v, lobe.y);
  return lobe.amplitude * max(dot(v, lobe.z), 0.0) * exp(-lobe.sharpness.x * x * x - lobe.sharpness.y * y * y);
}

// Integral over the sphere of exp(m (v.axis - 1)): 2 pi (1 - exp(-2 m)) / m, which tends to 4 pi at m = 0.
float lkIntegral(float m) {
  // Below 0.01 the difference 1 - exp(-2 m) cancels in 32 bits; its series to the second order does not.
  if (m < 0.01) return 4.0 * LK_PI * (1.0 - m + m * m * (2.0 / 3.0));
  return 2.0 * LK_PI * (1.0 - exp(-2.0 * m)) / m;
}

// Integral over the sphere of the product of two lobes, exact and free of overflow (eq. 21 to 23, corrected:
// 4 pi exp(-(l1 + l2)) sinh(m) / m with m = |l1 u1 + l2 u2|, which eq. 23 divides by l1 + l2).
vec3 lkProductIntegral(LkLobe a, LkLobe b) {
  float m = length(a.sharpness * a.axis + b.sharpness * b.axis);
  return a.amplitude * b.amplitude * lkIntegral(m) * exp(m - a.sharpness - b.sharpness);
}

// The normal distribution D(h) about the normal n for GGX width alpha, as a function of the incoming direction, seen
// from the unit direction o (eq. 17 and 18; Wang et al. 2009). x is perpendicular to the plane of incidence, where
// the lobe narrows towards grazing angles.
LkAnisotropicLobe lkReflectionLobe(vec3 n, vec3 o, float alpha) {
  float cosine = max(dot(n, o), 1e-4);
  float width = max(alpha * alpha, 1e-6);
  LkAnisotropicLobe lobe;
  lobe.z = normalize(2.0 * dot(n, o) * n - o);
  // Looking along the normal both sharpnesses agree, and any frame about z will do.
  vec3 across = cross(n, lobe.z);
  vec3 other = abs(lobe.z.y) < 0.9 ? vec3(0.0, 1.0, 0.0) : vec3(1.0, 0.0, 0.0);
  lobe.x = normalize(dot(across, across) > 1e-10 ? across : cross(other, lobe.z));
  lobe.y = cross(lobe.z, lobe.x);
  lobe.sharpness = (2.0 / width) / 8.0 * vec2(1.0 / (cosine * cosine), 1.0);
  lobe.amplitude = 1.0 / (LK_PI * width);
  return lobe;
}

// Integral over the sphere of a lobe times an anisotropic lobe (eq. 24, corrected: the Gaussian is evaluated at the
// lobe's axis with the reduced sharpnesses nu s / (nu + s), nu = sharpness / 2).
vec3 lkConvolve(LkLobe lobe, LkAnisotropicLobe kernel) {
  float nu = 0.5 * lobe.sharpness;
  vec2 sum = nu + kernel.sharpness;
  vec2 reduced = nu * kernel.sharpness / sum;
  float x = dot(lobe.axis, kernel.x);
  float y = dot(lobe.axis, kernel.y);
  float z = max(dot(lobe.axis, kernel.z), 0.0);
  float overlap = LK_PI * inversesqrt(sum.x * sum.y) * z * exp(-reduced.x * x * x - reduced.y * y * y);
  return lobe.amplitude * kernel.amplitude * overlap;
}
