// CHANNELS, LIGHTS and SHOW are defined before this: one program for each combination that is used.
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray planes;    // per channel (d, B), per channel (s, low flags), (w, high flags and mask)
uniform sampler2DArray measured;  // one layer a light, sRGB codes
uniform vec3 alpha[2];            // of lights of unit intensity
uniform float power[2];           // their intensities
uniform vec3 globals;             // n_d, softness, Fresnel share
uniform bool ggx;                 // the lobe of GGX microfacets, not a power
uniform mat3 M;                   // inverse of the basis directions, transposed
uniform float exponents[4];       // n_s of every material
uniform float ceilings[4];        // largest |M w| of every material
uniform float root_scale;
uniform float lobe_scale;         // of B
uniform vec3 faders;              // of the specular, and of the roots of local diffuse and scattering
uniform int measured_light;
uniform float measured_white;
uniform int flag_low, flag_high;
uniform float flag_base;          // 2 to the number of bits a half
uniform float gain;               // exposure over white
uniform int curve;
uniform float B_gain;
uniform vec4 place;               // picture = place.xy + window * place.zw, in pixels of this level
uniform ivec4 tile;               // first pixel and size without apron, in pixels of this level
uniform ivec2 held;               // pixels of the tile, apron included
uniform bool smoothed;
uniform vec4 lens;                // centre, radius, and 1 inside or -1 outside or 0 for no lens, in window pixels
out vec4 colour;

// SHOW: 0 whole, 1 specular, 2 local diffuse, 3 scattering, 4 whole diffuse, 5 measured, 6 B, 7 flags
const int MEASURED = 5, STRENGTH = 6, FLAGS = 7;

float positive_power(float base, float exponent) {
  if (!(base > 0.0)) return 0.0;
  return exponent == 1.0 ? base : pow(base, exponent);
}

// T(c): light that enters the body at the cosine c
float entered(float c) {
  float y = 0.5 * (c + sqrt(c * c + globals.y * globals.y)), rest = 1.0 - min(y, 1.0);
  return y * (1.0 - globals.z * rest * rest * rest * rest * rest);
}

float diffuse(vec3 roots, vec3 mix_) {
  float q = max(length(roots * M), 1e-6);
  return positive_power(q * entered(dot(roots, mix_) / q), globals.x);
}

// off-specular value of w = a + B m under a light: Eq. 17, or the lobe of GGX microfacets
float lobe(vec3 w, vec3 mix_, int kind) {
  float n = exponents[kind], full = max(length(w * M), 1e-6), size = min(full, ceilings[kind]), u = dot(w, mix_) * size / full;
  if (!ggx) return positive_power(u, n);
  if (!(u > 0.0)) return 0.0;
  float base = 1.0 + 0.5 * n * (1.0 - min(u / size, 1.0)), least = 1.0 + 0.5 * n;
  return pow(size, n) * (1.0 / (base * base) - 1.0 / (least * least));
}

// Eqs. 20 and 21 of one channel under one light
float value(vec3 d, vec3 s, float shine, vec3 mix_) {
  float n_d = globals.x;
#if SHOW == 1
  return shine;
#elif SHOW == 2
  return positive_power(dot(d, mix_), n_d);
#elif SHOW == 3
  return positive_power(dot(s, mix_), n_d);
#else
#if SHOW == 4
  return diffuse(d + s, mix_);
#else
  return faders.x * shine + diffuse(faders.y * d + faders.z * s, mix_);
#endif
#endif
}

// one channel under all lights, linear
float channel(ivec2 p, int c, vec3 w, int kind) {
  vec3 d = root_scale * texelFetch(planes, ivec3(p, c), 0).xyz;
  vec3 s = root_scale * texelFetch(planes, ivec3(p, CHANNELS + c), 0).xyz;
  float sum = power[0] * value(d, s, lobe(w, alpha[0], kind), alpha[0]);
#if LIGHTS == 2
  sum += power[1] * value(d, s, lobe(w, alpha[1], kind), alpha[1]);
#endif
  return sum;
}

vec3 reflectance(ivec2 p) {
  vec4 w = texelFetch(planes, ivec3(p, 2 * CHANNELS), 0);
  if (w.w < flag_base) return vec3(0.0);
  int kind = (int(w.w) >> 6) & 3;  // planes.MATERIAL_BIT
#if CHANNELS == 1
  return vec3(channel(p, 0, w.xyz, kind));
#else
  return vec3(channel(p, 0, w.xyz, kind), channel(p, 1, w.xyz, kind), channel(p, 2, w.xyz, kind));
#endif
}

vec3 measured_at(ivec2 p) {
  vec3 code = texelFetch(measured, ivec3(p, measured_light), 0).rgb;
  vec3 linear = mix(code / 12.92, pow((code + 0.055) / 1.055, vec3(2.4)), step(0.04045, code));
  return measured_white * (CHANNELS == 1 ? linear.rrr : linear);
}

vec3 radiance(ivec2 p) {
  p = clamp(p, ivec2(0), held - 1);
  if (SHOW == MEASURED) return measured_at(p);
  if (SHOW == STRENGTH) return vec3(B_gain * lobe_scale * texelFetch(planes, ivec3(p, 0), 0).w);
  return reflectance(p);
}

vec3 toned(vec3 linear) {
  if (any(isnan(linear))) return vec3(1.0, 0.0, 1.0);
  linear = max(linear, vec3(0.0));
  if (curve == 1) linear = linear * (1.0 + linear / 16.0) / (1.0 + linear);
  linear = min(linear, vec3(1.0));
  if (curve == 2) return linear;
  return mix(12.92 * linear, 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, linear));
}

vec3 flags_at(ivec2 p) {
  p = clamp(p, ivec2(0), held - 1);
  int high = int(texelFetch(planes, ivec3(p, 2 * CHANNELS), 0).w);
  int low = int(texelFetch(planes, ivec3(p, CHANNELS), 0).w);
  bool on = (low & flag_low) != 0 || (high & flag_high) != 0;
  vec3 grey = vec3(dot(toned(gain * reflectance(p)), vec3(0.3333)));
  return on ? mix(vec3(1.0, 0.69, 0.0), grey, 0.3) : 0.7 * grey;
}

void main() {
  vec2 window = gl_FragCoord.xy;
  if (lens.w != 0.0) {
    float far = distance(window, lens.xy) - lens.z;
    if (far > 0.0) discard;
    if (far > -2.0) { colour = vec4(1.0, 0.69, 0.0, 1.0); return; }
  }
  vec2 at = place.xy + window * place.zw;
  if (any(lessThan(at, vec2(tile.xy))) || any(greaterThanEqual(at, vec2(tile.xy + tile.zw)))) discard;
  at -= vec2(tile.xy);
  if (SHOW == FLAGS) { colour = vec4(flags_at(ivec2(floor(at))), 1.0); return; }
  float boost = SHOW == STRENGTH ? 1.0 : gain;
  if (!smoothed) { colour = vec4(toned(boost * radiance(ivec2(floor(at)))), 1.0); return; }
  vec2 corner = floor(at - 0.5), f = at - 0.5 - corner;
  ivec2 p = ivec2(corner);
  vec3 top = mix(radiance(p), radiance(p + ivec2(1, 0)), f.x);
  vec3 bottom = mix(radiance(p + ivec2(0, 1)), radiance(p + ivec2(1, 1)), f.x);
  colour = vec4(toned(boost * mix(top, bottom, f.y)), 1.0);
}
