// Spherical Gaussians and the glossy lobe they are convolved with. HLSL for shader model 4 and newer; no resources.
//
// Source: Currius et al. 2020, "Spherical Gaussian Light-field Textures for Fast Precomputed Global Illumination",
// section 6 and appendix B; equation numbers below are theirs. Equations 20 and 23 to 24 do not hold as printed; the
// forms here are corrected (Xu et al. 2013, "Anisotropic Spherical Gaussians", eq. 8 and 22).

#ifndef LK_SG_HLSL
#define LK_SG_HLSL

static const float LK_PI = 3.14159265358979;

// G(v) = amplitude exp(sharpness (v.axis - 1)).
struct LkLobe {
  float3 axis;
  float sharpness;
  float3 amplitude;
};

// amplitude max(v.z, 0) exp(-sharpness.x (v.x)^2 - sharpness.y (v.y)^2) in the frame x, y, z.
struct LkAnisotropicLobe {
  float3 x;
  float3 y;
  float3 z;
  float2 sharpness;
  float amplitude;
};

// Evaluate a lobe in the unit direction v (eq. 1).
float3 lkEvaluate(LkLobe lobe, float3 v) {
  return lobe.amplitude * exp(lobe.sharpness * (dot(v, lobe.axis) - 1.0));
}

// Evaluate an anisotropic lobe in the unit direction v (eq. 20 with squared dot products).
float lkEvaluateAnisotropic(LkAnisotropicLobe lobe, float3 v) {
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
float3 lkProductIntegral(LkLobe a, LkLobe b) {
  float m = length(a.sharpness * a.axis + b.sharpness * b.axis);
  return a.amplitude * b.amplitude * lkIntegral(m) * exp(m - a.sharpness - b.sharpness);
}

// (1 - exp(-s)) / s, 1 at s = 0.
float lkSaturated(float s) {
  // Below 0.01 the difference cancels in 32 bits.
  return s < 0.01 ? 1.0 - 0.5 * s : (1.0 - exp(-s)) / s;
}

// Integral over the sphere of max(v.z, 0) exp(-s.x (v.x)^2 - s.y (v.y)^2); exact where both sharpnesses agree.
float lkCap(float2 s) {
  return LK_PI * sqrt(lkSaturated(s.x) * lkSaturated(s.y));
}

// What a GGX surface of width alpha gathers light with, D G F (n.i) normalised: two lobes whose integrals add up to 1.
struct LkReflection {
  LkAnisotropicLobe peak;
  LkAnisotropicLobe tail;
  float tailShare;
};

// A lobe of a reflection from its tilt and the logarithms of its sharpnesses.
LkAnisotropicLobe lkReflectionLobe(float3 n, float3 specular, float3 across, float3 fit, float alpha, float integral) {
  LkAnisotropicLobe lobe;
  lobe.x = across;
  lobe.z = normalize(lerp(n, specular, 1.0 / (1.0 + exp(-fit.x))));
  lobe.y = cross(lobe.z, lobe.x);
  lobe.sharpness = exp(fit.yz) / (4.0 * alpha * alpha);
  lobe.amplitude = integral / lkCap(lobe.sharpness);
  return lobe;
}

// The single-scattering albedo of GGX is F0 A + B, the integral over i of D G F / (4 n.o): A and B, rational in o.n and
// alpha (the form of MaterialX' mx_ggx_dir_albedo_analytic, coefficients our own; within 2 % for alpha 0.04 to 1).
float2 lkAlbedoTerms(float x, float alpha) {
  float y = max(alpha, 0.04);
  float4 fit = float4(0.079654, 0.82584, 1.0, 1.0);
  fit += float4(-2.112, -1.9157, -2.3351, -2.4264) * (x);
  fit += float4(10.725, 0.021977, 9.5778, 10.771) * (y);
  fit += float4(-5.696, 0.58532, 0.54603, -6.4866) * (x * y);
  fit += float4(40.966, 1.088, 39.229, 18.855) * (x * x);
  fit += float4(-8.8396, 0.14768, -8.5177, 11.302) * (y * y);
  fit += float4(-40.58, -0.52883, -36.547, -51.571) * (x * x * y);
  fit += float4(24.516, -0.68548, 28.513, 105.32) * (x * y * y);
  fit += float4(-2.1546, 0.42731, 23.074, 52.019) * (x * x * y * y);
  return saturate(fit.xy / fit.zw);
}

// The reflection of a GGX surface seen from the unit direction o. Its lobes' axes leave the specular direction for the
// normal as alpha grows and the view lowers; tilts, sharpnesses and shares are polynomials in o.n and alpha, fitted to the
// microfacet model. The paper's eq. 17 and 18 (Wang et al. 2009) hold for smooth surfaces seen from above only.
LkReflection lkReflection(float3 n, float3 o, float alpha, float f0, float f90) {
  float x = clamp(dot(n, o), 1e-4, 1.0);
  float y = clamp(alpha, 0.04, 1.0);
  float3 peak = float3(3.6777, 5.49, -0.021158);
  peak += float3(-19.753, -13.842, 0.30818) * (y);
  peak += float3(2.9478, -10.454, 0.091509) * (x);
  peak += float3(37.346, 19.454, 6.2794) * (y * y);
  peak += float3(-9.1963, 24.932, 6.1928) * (y * x);
  peak += float3(10.519, 5.7541, -1.8453) * (x * x);
  peak += float3(-19.014, -11.536, -3.5664) * (y * y * y);
  peak += float3(-3.1945, -10.719, -4.4632) * (y * y * x);
  peak += float3(6.0982, -12.137, -6.0564) * (y * x * x);
  peak += float3(-10.127, -0.65908, 1.8442) * (x * x * x);
  float4 tail = float4(1.9791, 0.73549, -2.9924, -0.99093);
  tail += float4(-22.82, -18.607, 4.7089, 2.776) * (y);
  tail += float4(8.3079, 1.2791, 5.0207, -1.9232) * (x);
  tail += float4(29.596, 17.517, -17.214, 2.508) * (y * y);
  tail += float4(-16.878, 29.174, 15.763, -4.0843) * (y * x);
  tail += float4(-12.738, -12.391, -12.476, 1.8806) * (x * x);
  tail += float4(-18.206, -3.9007, 7.7688, -2.5371) * (y * y * y);
  tail += float4(14.61, -21.17, 2.3152, 7.7452) * (y * y * x);
  tail += float4(4.2414, -7.5434, -15.977, -1.8843) * (y * x * x);
  tail += float4(8.5499, 8.1529, 8.179, 0.41033) * (x * x * x);
  float3 dullPeak = float3(3.5087, 6.1466, 0.31717);
  dullPeak += float3(-14.927, -10.617, 6.4329) * (y);
  dullPeak += float3(9.2442, -14.179, -1.8546) * (x);
  dullPeak += float3(29.136, 9.8029, -9.0838) * (y * y);
  dullPeak += float3(-31.547, 29.464, 0.10216) * (y * x);
  dullPeak += float3(29.477, 10.305, -0.10713) * (x * x);
  dullPeak += float3(-15.734, -3.2611, 5.5563) * (y * y * y);
  dullPeak += float3(15.375, -14.138, 3.72) * (y * y * x);
  dullPeak += float3(16.159, -16.38, -5.3183) * (y * x * x);
  dullPeak += float3(-38.25, -2.3315, 1.7695) * (x * x * x);
  float4 dullTail = float4(1.3469, 2.2693, -1.3649, -0.99691);
  dullTail += float4(-5.5116, -6.286, 15.816, -0.72569) * (y);
  dullTail += float4(13.53, -7.131, -4.976, -0.93423) * (x);
  dullTail += float4(6.6684, -9.3215, -46.173, 1.9492) * (y * y);
  dullTail += float4(-60.773, 21.151, 0.14139, 0.80545) * (y * x);
  dullTail += float4(-8.4247, -0.30667, 3.119, 0.68347) * (x * x);
  dullTail += float4(-8.5622, 9.0538, 27.477, -0.67734) * (y * y * y);
  dullTail += float4(33.409, -6.9217, 9.3747, 3.9864) * (y * y * x);
  dullTail += float4(29.369, -9.6045, -7.3724, -1.3311) * (y * x * x);
  dullTail += float4(-1.2706, 2.8032, 0.73681, 0.4454) * (x * x * x);
  // Schlick's F of any F0 is a sum of 1 and of that of 0.04: the parameters are mixed by what each part reflects.
  float2 ab = lkAlbedoTerms(x, y);
  float part = (f90 - f0) / 0.96 * (0.04 * ab.x + ab.y) / max(f0 * ab.x + f90 * ab.y, 1e-6);
  float share = clamp(part, 0.0, 1.0);
  peak = lerp(peak, dullPeak, share);
  tail = lerp(tail, dullTail, share);
  float3 specular = 2.0 * dot(n, o) * n - o;
  // Perpendicular to the plane of incidence; looking along the normal any frame about z will do.
  float3 across = cross(n, specular);
  float3 other = abs(specular.y) < 0.9 ? float3(0.0, 1.0, 0.0) : float3(1.0, 0.0, 0.0);
  across = normalize(dot(across, across) > 1e-10 ? across : cross(other, specular));
  LkReflection reflection;
  reflection.tailShare = 1.0 / (1.0 + exp(-tail.w));
  reflection.peak = lkReflectionLobe(n, specular, across, peak, y, 1.0 - reflection.tailShare);
  reflection.tail = lkReflectionLobe(n, specular, across, tail.xyz, y, reflection.tailShare);
  return reflection;
}

// Integral over the sphere of a lobe times an anisotropic lobe: eq. 24, corrected (the Gaussian is evaluated at the lobe's
// axis with the reduced sharpnesses nu s / (nu + s), nu = sharpness / 2) and made sound for wide lobes: distances are
// chords, the cosine is taken at the product's centre, and the hemisphere about it is what is integrated over.
float3 lkConvolve(LkLobe lobe, LkAnisotropicLobe kernel) {
  float nu = 0.5 * lobe.sharpness;
  float2 sum = nu + kernel.sharpness;
  float2 reduced = nu * kernel.sharpness / sum;
  float x = dot(lobe.axis, kernel.x);
  float y = dot(lobe.axis, kernel.y);
  float z = dot(lobe.axis, kernel.z);
  // The chord's square, 2 (1 - z), times the sharpness in its direction; straight behind, the mean of both.
  float behind = z > 0.0 ? 0.0 : 1e-6;
  float xx = x * x + behind;
  float yy = y * y + behind;
  float chord = z > 0.0 ? 2.0 / (1.0 + z) : 2.0 * (1.0 - z) / (xx + yy);
  float exponent = (reduced.x * xx + reduced.y * yy) * chord;
  float width = 0.5 * (kernel.sharpness.x + kernel.sharpness.y) + 0.5;
  float centre = (nu * z + width) * rsqrt(max(nu * nu + width * width + 2.0 * nu * width * z, 1e-9));
  float overlap = lkCap(sum) * saturate(centre) * exp(-exponent);
  return lobe.amplitude * kernel.amplitude * overlap;
}

// The mean of a lobe under a reflection.
float3 lkMeanUnder(LkLobe lobe, LkReflection reflection) {
  return lkConvolve(lobe, reflection.peak) + lkConvolve(lobe, reflection.tail);
}

#endif
