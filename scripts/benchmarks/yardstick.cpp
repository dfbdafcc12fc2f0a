// The yardstick: `solve_blocks` on `PixelProblem` by hand, for one core, in vectors of double precision.
//
// The same residuals, damping and end as the fit's, the lobe that of GGX microfacets, the globals given. LIGHTS,
// CHANNELS and WIDTH (pixels in a vector) are set by the compiler's command line. Lanes whose pixel has ended are
// refilled at once.
#include <cmath>
#include <cstdint>
#include <cstring>

constexpr int W = WIDTH, N = LIGHTS, C = CHANNELS, P = 3 * C + 1, HALF = P * (P + 1) / 2;
typedef double V __attribute__((vector_size(8 * W)));
typedef int64_t I __attribute__((vector_size(8 * W)));

constexpr double TINY = 1e-12, LEAST = 2.2250738585072014e-308, EPS = 2.220446049250313e-16;
constexpr double FIRST_DAMPING = 1e-3, LEAST_DAMPING = 1e-9, MOST_DAMPING = 1e8, ACCEPTED_GAIN = 1e-4, FIRMNESS = 1e-9;

static inline V splat(double x) { return V{} + x; }
static inline V choose(I m, V a, V b) { return m ? a : b; }
static inline V max_(V a, V b) { return a > b ? a : b; }
static inline V min_(V a, V b) { return a < b ? a : b; }
static inline V abs_(V a) { return (V)((I)a & 0x7fffffffffffffff); }
static inline V square(V a) { return a * a; }
static inline V sqrt_(V x) {
  V y;
  for (int i = 0; i < W; ++i) y[i] = std::sqrt(x[i]);
  return y;
}

// Natural logarithm of a normal x > 0: 2 artanh((m - 1) / (m + 1)) as a series.
static inline V log_(V x) {
  I e = (((I)x >> 52) & 2047) - 1022;
  V m = (V)(((I)x & 0x000fffffffffffff) | 0x3fe0000000000000);  // [1/2, 1)
  I low = m < 0.70710678118654752;
  e += low;  // low is -1 where true
  m = choose(low, m + m, m);
  V z = (m - 1.0) / (m + 1.0), zz = z * z, y = splat(1.0 / 21);
#pragma GCC unroll 16
  for (int k = 19; k > 0; k -= 2) y = y * zz + 1.0 / k;
  V n = __builtin_convertvector(e, V);
  return n * 0.693147180369123816490 + (2.0 * z * y + n * 1.90821492927058770002e-10);
}

// Exponential by its series about the nearest multiple of log 2; held between -700 and 700.
static inline V exp_(V x) {
  x = min_(max_(x, splat(-700.0)), splat(700.0));
  V t = x * 1.44269504088896341;
  I k = __builtin_convertvector(t + choose(t < 0.0, splat(-0.5), splat(0.5)), I);
  V n = __builtin_convertvector(k, V);
  V r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10, y = splat(1.0);
#pragma GCC unroll 16
  for (int i = 13; i > 0; --i) y = y * r / (double)i + 1.0;
  return y * (V)((k + 1023) << 52);
}

// As `constants` of yardstick.py lays it out.
struct Shared {
  double alpha[N][3], weight[N], M[3][3], a[3], n_s, f, softness, fresnel, n_d, log_size, spread, huber, near;
};

struct Pixel {
  V image[N][C], s[N][C], clipped[N][C], R[6], v0[3];
};
constexpr int VALUES = sizeof(Pixel) / sizeof(V);

struct Normal {
  V cost, g[P], v[HALF];
};

static constexpr int at(int row, int column) { return row * (row + 1) / 2 + column; }

static void evaluate(const V* l, const Pixel& p, const Shared& c, Normal& q) {
  const V B = exp_(l[P - 1]), share = B / (double)C;
  V own[C][6] = {}, K[C][3][3] = {}, gd[C][3] = {}, Hz[6] = {}, gz[3] = {}, cost = {};
  V length[C], radial[C][3], z[3] = {}, Mv[3], direction[3], v[3];
  for (int e = 0; e < C; ++e) {
    V b[3], Mb[3];
    for (int k = 0; k < 3; ++k) b[k] = l[k * C + e] + p.s[k][e], z[k] += b[k] - c.f * p.s[k][e];
    for (int k = 0; k < 3; ++k) Mb[k] = c.M[k][0] * b[0] + c.M[k][1] * b[1] + c.M[k][2] * b[2];
    length[e] = sqrt_(square(Mb[0]) + square(Mb[1]) + square(Mb[2]) + TINY);
    V per = 1.0 / length[e];
    for (int k = 0; k < 3; ++k) radial[e][k] = (c.M[0][k] * Mb[0] + c.M[1][k] * Mb[1] + c.M[2][k] * Mb[2]) * per;
  }
  for (int k = 0; k < 3; ++k) z[k] *= share, v[k] = c.a[k] + z[k];
  for (int k = 0; k < 3; ++k) Mv[k] = c.M[k][0] * v[0] + c.M[k][1] * v[1] + c.M[k][2] * v[2];
  const V size = sqrt_(square(Mv[0]) + square(Mv[1]) + square(Mv[2]) + TINY), inverse = 1.0 / size;
  for (int k = 0; k < 3; ++k) direction[k] = (c.M[0][k] * Mv[0] + c.M[1][k] * Mv[1] + c.M[2][k] * Mv[2]) * inverse;
  const V log_size = log_(size), height = exp_(c.n_s * log_size);
  const double floor = 1.0 / ((1.0 + 0.5 * c.n_s) * (1.0 + 0.5 * c.n_s));
  for (int j = 0; j < N; ++j) {
    const double* A = c.alpha[j];
    V t = (A[0] * v[0] + A[1] * v[1] + A[2] * v[2]) * inverse;
    V base = 1.0 / (1.0 + 0.5 * c.n_s * (1.0 - min_(max_(t, V{}), splat(1.0))));
    V shine = choose(t > 0.0, height * (square(base) - floor), V{});
    V by_t = choose((t > 0.0) & (t < 1.0), height * c.n_s * square(base) * base, V{});
    V by_size = (c.n_s * shine - t * by_t) * inverse, G[3], total = {}, pull = {};
    for (int k = 0; k < 3; ++k) G[k] = by_t * inverse * A[k] + by_size * direction[k];
    for (int e = 0; e < C; ++e) {
      V x = A[0] * l[e] + A[1] * l[C + e] + A[2] * l[2 * C + e] + p.s[j][e], cosine = x / length[e];
      V root = sqrt_(square(cosine) + c.softness * c.softness + TINY), y = 0.5 * (cosine + root);
      V rest = 1.0 - min_(y, splat(1.0)), rest4 = square(square(rest)), entered = 1.0 - c.fresnel * rest4 * rest;
      V T = y * entered, slope = (entered + 5.0 * c.fresnel * y * rest4) * (y / root);
      V body = length[e] * T, by_length = T - cosine * slope;
      if (c.n_d != 1.0) {
        I lit = body > 0.0;
        V power = choose(lit, exp_(c.n_d * log_(choose(lit, body, splat(1.0)))), V{});
        V chain = c.n_d * power / max_(body, splat(1e-30));
        body = power, slope *= chain, by_length *= chain;
      }
      V misfit = body + shine - p.image[j][e];
      I silent = (p.clipped[j][e] != 0.0) & (misfit > 0.0);
      V scale = choose(silent, V{}, splat(c.weight[j])), r = misfit * scale, far = abs_(r);
      V trust = c.huber / max_(far, splat(c.huber));
      cost += choose(far < c.huber, 0.5 * square(r), c.huber * (far - 0.5 * c.huber));
      V rw = trust * r, ws = trust * scale, Phi[3];
      total += ws * scale, pull += rw * scale;
      for (int k = 0; k < 3; ++k) {
        Phi[k] = (slope * A[k] + by_length * radial[e][k]) * scale;
        gd[e][k] += Phi[k] * rw;
        V cross = Phi[k] * ws, Pw = Phi[k] * trust;
        for (int i = 0; i < 3; ++i) K[e][k][i] += cross * G[i];
        for (int i = 0; i <= k; ++i) own[e][at(k, i)] += Pw * Phi[i];
      }
    }
    for (int k = 0; k < 3; ++k) {
      gz[k] += G[k] * pull;
      for (int i = 0; i <= k; ++i) Hz[at(k, i)] += G[k] * G[i] * total;
    }
  }
  auto expect = [&](V row, V first, V second, V third) {
    V by[3] = {first, second, third};
    cost += 0.5 * square(row);
    for (int k = 0; k < 3; ++k) {
      gz[k] += row * by[k];
      for (int i = 0; i <= k; ++i) Hz[at(k, i)] += by[k] * by[i];
    }
  };
  V gloss = splat(c.n_s / c.spread), steep = gloss * inverse;
  expect(gloss * (log_size - c.log_size), steep * direction[0], steep * direction[1], steep * direction[2]);
  if (c.near != 0.0) {
    const V* R = p.R;
    V o[3];
    for (int k = 0; k < 3; ++k) o[k] = z[k] * c.near - p.v0[k];
    expect(R[0] * o[0] + R[1] * o[1] + R[2] * o[2], R[0] * c.near, R[1] * c.near, R[2] * c.near);
    expect(R[3] * o[1] + R[4] * o[2], V{}, R[3] * c.near, R[4] * c.near);
    expect(R[5] * o[2], V{}, V{}, R[5] * c.near);
  }
  auto H = [&](int k, int i) { return k >= i ? Hz[at(k, i)] : Hz[at(i, k)]; };
  V Hzz[3], squared = square(share);
  for (int k = 0; k < 3; ++k) Hzz[k] = H(k, 0) * z[0] + H(k, 1) * z[1] + H(k, 2) * z[2];
  for (int k = 0; k < 3; ++k)
    for (int e = 0; e < C; ++e) {
      int row = k * C + e;
      q.g[row] = gd[e][k] + share * gz[k];
      for (int i = 0; i <= k; ++i)
        for (int h = 0; h < (i == k ? e + 1 : C); ++h)
          q.v[at(row, i * C + h)] = share * (K[e][k][i] + K[h][i][k]) + squared * H(k, i) + (e == h ? own[e][at(k, i)] : V{});
      q.v[at(P - 1, row)] = K[e][k][0] * z[0] + K[e][k][1] * z[1] + K[e][k][2] * z[2] + share * Hzz[k];
    }
  q.g[P - 1] = gz[0] * z[0] + gz[1] * z[1] + gz[2] * z[2];
  q.v[at(P - 1, P - 1)] = Hzz[0] * z[0] + Hzz[1] * z[1] + Hzz[2] * z[2];
  q.cost = cost;
}

// x of (V + diag(damping)) x = -g, by L D L^T.
static void solve(const Normal& q, const V* damping, V* x) {
  V L[HALF], inverse[P], least[P];
  std::memcpy(L, q.v, sizeof L);
  for (int k = 0; k < P; ++k) L[at(k, k)] += damping[k], least[k] = 4 * EPS * abs_(L[at(k, k)]) + LEAST, x[k] = -q.g[k];
  for (int k = 0; k < P; ++k) {
    inverse[k] = 1.0 / max_(L[at(k, k)], least[k]);
    for (int i = k + 1; i < P; ++i) {
      V l = L[at(i, k)] * inverse[k];
      for (int m = k + 1; m <= i; ++m) L[at(i, m)] -= l * L[at(m, k)];
      x[i] -= l * x[k];
    }
    for (int i = k + 1; i < P; ++i) L[at(i, k)] *= inverse[k];
  }
  for (int k = 0; k < P; ++k) x[k] *= inverse[k];
  for (int k = P - 1; k > 0; --k)
    for (int i = 0; i < k; ++i) x[i] -= L[at(k, i)] * x[k];
}

struct Lanes {
  V l[P], damping, count;
  Pixel pixel;
  Normal at;
  I live, fresh;
};

// One iteration of all lanes; returns those that are done. A fresh lane is only evaluated.
static I iterate(Lanes& z, const Shared& c, double tolerance, double limit) {
  V scale[P], damped[P], step[P], trial[P], most = z.at.v[0], foretold = {};
  for (int k = 1; k < P; ++k) most = max_(most, z.at.v[at(k, k)]);
  for (int k = 0; k < P; ++k) {
    scale[k] = max_(z.at.v[at(k, k)], FIRMNESS * most + LEAST);
    damped[k] = z.damping * scale[k];
  }
  solve(z.at, damped, step);
  for (int k = 0; k < P; ++k) {
    foretold -= 0.5 * step[k] * (z.at.g[k] - damped[k] * step[k]);
    trial[k] = choose(z.fresh, z.l[k], z.l[k] + step[k]);
  }
  Normal now;
  evaluate(trial, z.pixel, c, now);
  V fall = z.at.cost - now.cost, gain = fall / foretold;
  I better = ~z.fresh & (gain > ACCEPTED_GAIN);
  I ended = (better & (fall <= tolerance * z.at.cost)) | (foretold <= 0.1 * tolerance * z.at.cost);
  I stuck = ~ended & (z.damping >= MOST_DAMPING) & ~better;
  V bent = 2.0 * min_(max_(gain, V{}), splat(1.0)) - 1.0;
  V factor = choose(better, min_(max_(1.0 - bent * bent * bent, splat(0.1)), splat(2.0)), splat(6.0));
  factor = choose(z.fresh, splat(1.0), factor);
  z.damping = min_(max_(z.damping * factor, splat(LEAST_DAMPING)), splat(MOST_DAMPING));
  z.count += choose(z.fresh, V{}, splat(1.0));
  I lost = z.fresh & ~(abs_(now.cost) < 1e300), taken = better | z.fresh;
  for (int k = 0; k < P; ++k) z.l[k] = choose(taken, trial[k], z.l[k]);
  for (int k = 0; k < P; ++k) z.at.g[k] = choose(taken, now.g[k], z.at.g[k]);
  for (int k = 0; k < HALF; ++k) z.at.v[k] = choose(taken, now.v[k], z.at.v[k]);
  z.at.cost = choose(taken, now.cost, z.at.cost);
  I done = (~z.fresh & (ended | stuck | (z.count >= limit))) | lost;
  z.fresh = I{};
  return done & z.live;
}

// values: what a `Pixel` holds, a row each, pixels last. local (P, pixels) is where every pixel starts, then ends.
extern "C" int64_t solve_pixels(
    int64_t pixels, const double* values, const double* constants, double tolerance, int64_t limit, double* local,
    double* cost) {
  Shared c;
  std::memcpy(&c, constants, sizeof c);
  static thread_local Lanes z;
  std::memset(&z, 0, sizeof z);
  V* held = (V*)&z.pixel;
  int64_t place[W], next = 0, total = 0, running = 0;
  auto put = [&](int i) {
    z.live[i] = next < pixels ? -1 : 0;
    if (next >= pixels) return;
    for (int k = 0; k < VALUES; ++k) held[k][i] = values[k * pixels + next];
    for (int k = 0; k < P; ++k) z.l[k][i] = local[k * pixels + next];
    z.fresh[i] = -1, z.count[i] = 0, z.damping[i] = FIRST_DAMPING;
    place[i] = next++, ++running;
  };
  for (int i = 0; i < W; ++i) put(i);
  while (running) {
    I done = iterate(z, c, tolerance, (double)limit);
    for (int i = 0; i < W; ++i) {
      if (!done[i]) continue;
      for (int k = 0; k < P; ++k) local[k * pixels + place[i]] = z.l[k][i];
      cost[place[i]] = z.at.cost[i];
      total += (int64_t)z.count[i];
      --running;
      put(i);
    }
  }
  return total;
}
