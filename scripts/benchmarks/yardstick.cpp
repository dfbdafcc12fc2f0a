// The yardstick: the algorithm of reflectsep/kernel by hand, for one core, in float32 vectors.
//
//   x_j = A_j (d + s),  u_j = A_j (a + B d),  r_j = (x_j)_+ + (u_j)_+^n_s - I_j,   l = (d_1, d_2, d_3, log B)
//
// LIGHTS is set by the compiler's command line; n_d = 1. Lanes whose pixel is finished are refilled at once.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <initializer_list>

#ifndef LIGHTS
#define LIGHTS 6
#endif

constexpr int W = 16, N = LIGHTS;
typedef float V __attribute__((vector_size(4 * W)));
typedef int32_t I __attribute__((vector_size(4 * W)));

static inline V splat(float x) { return V{} + x; }
static inline V choose(I m, V a, V b) { return m ? a : b; }
static inline V max_(V a, V b) { return a > b ? a : b; }
static inline V min_(V a, V b) { return a < b ? a : b; }

// a < b for costs, false where a is no number: by their bits, since -ffast-math takes every number for finite.
static inline I less_(V a, V b) { return ((I)a & 0x7fffffff) < ((I)b & 0x7fffffff); }

// Natural logarithm of x > 0, to about 2 units in the last place.
static inline V log_(V x) {
  I bits = (I)x;
  I e = ((bits >> 23) & 255) - 126;
  V m = (V)((bits & 0x007fffff) | 0x3f000000);  // [1/2, 1)
  I low = m < 0.707106781f;
  e += low;  // low is -1 where true
  m = choose(low, m + m, m) - 1.0f;
  V k = __builtin_convertvector(e, V), z = m * m;
  V y = splat(7.0376836292e-2f);
  y = y * m - 1.1514610310e-1f;
  y = y * m + 1.1676998740e-1f;
  y = y * m - 1.2420140846e-1f;
  y = y * m + 1.4249322787e-1f;
  y = y * m - 1.6668057665e-1f;
  y = y * m + 2.0000714765e-1f;
  y = y * m - 2.4999993993e-1f;
  y = y * m + 3.3333331174e-1f;
  y = y * m * z + k * -2.12194440e-4f - 0.5f * z;
  return m + y + k * 0.693359375f;
}

// Exponential, to about 2 units in the last place; 0 below -87.
static inline V exp_(V x) {
  I small = x < -87.0f;
  x = min_(max_(x, splat(-87.0f)), splat(88.0f));
  V t = x * 1.44269504088896341f;
  I k = __builtin_convertvector(t + choose(t < 0.0f, splat(-0.5f), splat(0.5f)), I);
  V f = __builtin_convertvector(k, V);
  V r = x - f * 0.693359375f + f * 2.12194440e-4f;
  V y = splat(1.9875691500e-4f);
  y = y * r + 1.3981999507e-3f;
  y = y * r + 8.3334519073e-3f;
  y = y * r + 4.1665795894e-2f;
  y = y * r + 1.6666665459e-1f;
  y = y * r + 5.0000001201e-1f;
  y = y * r * r + r + 1.0f;
  return choose(small, splat(0.0f), y * (V)((k + 127) << 23));
}

struct Shared {
  float alpha[N][3], u0[N], weight[N], n_s, a[3];
};

struct Quadratic {
  V cost, g[4], v[10];
};

// Derivatives by the shared parameters (a_1, a_2, a_3, n_s) beside those of a pixel's own.
struct Cross {
  V w[4][4], h[10], g[4];
};

template <bool SHARED>
static inline void evaluate(const V* l, const V* image, const V* s, const Shared& c, Quadratic& q, Cross* x) {
  V cost = {}, g[4] = {}, v[10] = {}, B = exp_(l[3]), inverse_b = 1.0f / B;
  Cross z = {};
#pragma GCC unroll 16
  for (int j = 0; j < N; ++j) {
    const float* A = c.alpha[j];
    V y = j < 3 ? l[j] : A[0] * l[0] + A[1] * l[1] + A[2] * l[2];
    V root = y + (j < 3 ? s[j] : A[0] * s[0] + A[1] * s[1] + A[2] * s[2]);
    V u = c.u0[j] + B * y, lu = log_(max_(u, splat(1e-30f)));
    V p = exp_((c.n_s - 1.0f) * lu), shine = p * max_(u, V{}), f = c.n_s * p * B;
    V r = max_(root, V{}) + shine - image[j], t = choose(root > 0.0f, splat(1.0f), V{}) + f;
    V w = splat(c.weight[j]), wr = w * r, wq = w * t, fy = f * y;
    V square = wq * t, cross = wq * fy, pull = t * wr;
    cost += wr * r;
    g[3] += fy * wr;
    v[9] += w * fy * fy;
    if (j < 3) {
      const int dia[3] = {0, 4, 7}, bor[3] = {3, 6, 8};
      g[j] += pull, v[dia[j]] += square, v[bor[j]] += cross;
    } else {
      g[0] += A[0] * pull, g[1] += A[1] * pull, g[2] += A[2] * pull;
      v[0] += A[0] * A[0] * square, v[1] += A[0] * A[1] * square, v[2] += A[0] * A[2] * square;
      v[4] += A[1] * A[1] * square, v[5] += A[1] * A[2] * square, v[7] += A[2] * A[2] * square;
      v[3] += A[0] * cross, v[6] += A[1] * cross, v[8] += A[2] * cross;
    }
    if (SHARED) {
      V e = f * inverse_b, n = shine * lu, we = w * e, wn = w * n;
      V te = t * we, tn = t * wn, fe = fy * we, ee = e * we, en = e * wn;
#pragma GCC unroll 4
      for (int k = 0; k < 3; ++k) {
        if (j < 3 && k != j) continue;
        float Ak = j < 3 ? 1.0f : A[k];
        z.g[k] += Ak * (e * wr);
        z.w[3][k] += Ak * fe;
        z.w[k][3] += Ak * tn;
        static const int at[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
        z.h[at[k][3]] += Ak * en;
        for (int m = 0; m < 3; ++m) {
          if (j < 3 && m != j) continue;
          float Am = j < 3 ? 1.0f : A[m];
          z.w[k][m] += Ak * Am * te;
          if (m >= k) z.h[at[k][m]] += Ak * Am * ee;
        }
      }
      z.g[3] += n * wr, z.w[3][3] += fy * wn, z.h[9] += n * wn;
    }
  }
  if (SHARED) *x = z;
  q.cost = 0.5f * cost;
  std::memcpy(q.g, g, sizeof g), std::memcpy(q.v, v, sizeof v);
}

struct Factor {
  V l10, l20, l30, l21, l31, l32, i0, i1, i2, i3;
};

static inline void scales(const V* v, V* scale) {
  V least = 1e-9f * (v[0] + v[4] + v[7] + v[9]) + 1e-30f;
  scale[0] = max_(v[0], least), scale[1] = max_(v[4], least), scale[2] = max_(v[7], least), scale[3] = max_(v[9], least);
}

static inline Factor factorise(const V* v, const V* damping) {
  constexpr float eps = 4 * 1.1920929e-7f;
  Factor f;
  V s00 = v[0] + damping[0], s11 = v[4] + damping[1], s22 = v[7] + damping[2], s33 = v[9] + damping[3];
  f.i0 = 1.0f / s00;
  f.l10 = v[1] * f.i0, f.l20 = v[2] * f.i0, f.l30 = v[3] * f.i0;
  f.i1 = 1.0f / max_(s11 - f.l10 * v[1], eps * s11);
  V c21 = v[5] - f.l20 * v[1], c31 = v[6] - f.l30 * v[1];
  f.l21 = c21 * f.i1, f.l31 = c31 * f.i1;
  f.i2 = 1.0f / max_(s22 - f.l20 * v[2] - f.l21 * c21, eps * s22);
  V c32 = v[8] - f.l30 * v[2] - f.l31 * c21;
  f.l32 = c32 * f.i2;
  f.i3 = 1.0f / max_(s33 - f.l30 * v[3] - f.l31 * c31 - f.l32 * c32, eps * s33);
  return f;
}

static inline void solve(const Factor& f, V b0, V b1, V b2, V b3, V* x) {
  V y0 = b0, y1 = b1 - f.l10 * y0, y2 = b2 - f.l20 * y0 - f.l21 * y1;
  V y3 = b3 - f.l30 * y0 - f.l31 * y1 - f.l32 * y2;
  x[3] = y3 * f.i3;
  x[2] = y2 * f.i2 - f.l32 * x[3];
  x[1] = y1 * f.i1 - f.l21 * x[2] - f.l31 * x[3];
  x[0] = y0 * f.i0 - f.l10 * x[1] - f.l20 * x[2] - f.l30 * x[3];
}

struct Stop {
  float tolerance, floor;
  int32_t iterations;
};

struct Lanes {
  V l[4], cost, mu, image[N], s[3];
  Quadratic q;
  I count, live, fresh;
};

constexpr float LOW = -7.0f, HIGH = 7.0f;

// One iteration of all lanes; returns those that are done.
static inline I iterate(Lanes& z, const Shared& c, const Stop& stop) {
  V g[4], v[10], scale[4], damping[4], x[4], trial[4];
  std::memcpy(g, z.q.g, sizeof g), std::memcpy(v, z.q.v, sizeof v);
  I held = ((z.l[3] <= LOW) & (g[3] > 0.0f)) | ((z.l[3] >= HIGH) & (g[3] < 0.0f));
  g[3] = choose(held, V{}, g[3]);
  for (int k : {3, 6, 8}) v[k] = choose(held, V{}, v[k]);
  scales(v, scale);
  V promised = {};
  for (int k = 0; k < 4; ++k) damping[k] = z.mu * scale[k];
  Factor f = factorise(v, damping);
  solve(f, g[0], g[1], g[2], g[3], x);
  for (int k = 0; k < 4; ++k) promised += x[k] * (g[k] + damping[k] * x[k]), trial[k] = choose(z.fresh, z.l[k], z.l[k] - x[k]);
  trial[3] = min_(max_(trial[3], splat(LOW)), splat(HIGH));
  Quadratic q;
  evaluate<false>(trial, z.image, z.s, c, q, nullptr);
  I better = less_(q.cost, z.cost) & z.live;
  for (int k = 0; k < 4; ++k) z.l[k] = choose(better, trial[k], z.l[k]), z.q.g[k] = choose(better, q.g[k], z.q.g[k]);
  for (int k = 0; k < 10; ++k) z.q.v[k] = choose(better, q.v[k], z.q.v[k]);
  V mu = choose(z.fresh, splat(1e-3f), choose(better, max_(z.mu * 0.2f, splat(1e-9f)), z.mu * 5.0f));
  z.count -= ~z.fresh & z.live;
  I done = (0.5f * promised <= stop.tolerance * z.cost + stop.floor) | (mu > 1e9f) | (z.count >= stop.iterations);
  done = ((done & ~z.fresh) | (z.fresh & ~better)) & z.live;
  z.cost = choose(better, q.cost, z.cost);
  z.mu = mu;
  z.fresh = I{};
  return done;
}

extern "C" int64_t local_fit(
    int64_t pixels, const float* image, const float* s, const float* constants, float tolerance, float floor,
    int32_t iterations, float* local, float* cost) {
  Shared c;
  std::memcpy(&c, constants, sizeof c);
  Stop stop{tolerance, floor, iterations};
  Lanes z = {};
  int64_t at[W], next = 0, total = 0;
  int running = 0;
  auto put = [&](int i) {
    if (next >= pixels) {
      z.live[i] = 0;
      return;
    }
    at[i] = next;
    for (int j = 0; j < N; ++j) z.image[j][i] = image[j * pixels + next];
    for (int k = 0; k < 3; ++k) z.s[k][i] = s[k * pixels + next];
    for (int k = 0; k < 4; ++k) z.l[k][i] = local[k * pixels + next];
    z.cost[i] = 3e38f, z.fresh[i] = -1, z.live[i] = -1, z.count[i] = 0, z.mu[i] = 1.0f;
    ++next, ++running;
  };
  for (int i = 0; i < W; ++i) put(i);
  while (running) {
    I done = iterate(z, c, stop);
    uint32_t mask = 0;
    for (int i = 0; i < W; ++i) mask |= (done[i] & 1) << i;
    while (mask) {
      int i = __builtin_ctz(mask);
      mask &= mask - 1;
      for (int k = 0; k < 4; ++k) local[k * pixels + at[i]] = z.l[k][i];
      cost[at[i]] = z.cost[i];
      total += z.count[i];
      --running;
      put(i);
    }
  }
  return total;
}

// ---------------------------------------------------------------- the whole job: search over B, polish the best minima

constexpr int MINIMA = 3;

static inline V hermite(V t, V a, V da, V b, V db) {
  V away = b - a;
  return a + t * (da + t * (3.0f * away - 2.0f * da - db + t * (da + db - 2.0f * away)));
}

// Minima of W pixels over log B at `values` offsets: per pixel MINIMA times (cost, log B, d_1, d_2, d_3).
static inline void scan(const V* image, const V* s, const Shared& c, const float* offsets, int values, V best[MINIMA][5]) {
  const V big = splat(3e38f);
  V target[3], limit_a[3], top[3], d[3], along[3] = {};
  for (int k = 0; k < 3; ++k) {
    target[k] = max_(image[k], splat(1e-5f));
    limit_a[k] = d[k] = target[k] - s[k];
    top[k] = exp_(log_(target[k]) * (1.0f / c.n_s));
  }
  V peak = splat(-2.0f / 3.0f * (c.a[0] + c.a[1] + c.a[2]));
  V centre = log_(max_(peak, splat(1e-3f)) / max_((d[0] + d[1] + d[2]) * (1.0f / 3), splat(1e-4f)));
  for (int m = 0; m < MINIMA; ++m) {
    best[m][0] = big, best[m][1] = centre;
    for (int k = 0; k < 3; ++k) best[m][2 + k] = d[k];
  }
  V old = big, slope = splat(-1.0f);
  for (int i = 0; i <= values; ++i) {
    bool opening = i == 0, closing = i == values;
    float step = opening ? 0.0f : closing ? 1.0f : offsets[i] - offsets[i - 1];
    V cost, rise, e[3], turn[3], log_b = centre + (closing ? offsets[values - 1] + 1.0f : offsets[i]);
    if (closing) {
      cost = big, rise = splat(1.0f);
      for (int k = 0; k < 3; ++k) e[k] = d[k], turn[k] = along[k];
    } else {
      V B = exp_(log_b), inverse_b = 1.0f / B;
      for (int k = 0; k < 3; ++k) {
        V limit = min_(limit_a[k], (top[k] - c.u0[k]) * inverse_b);
        V x = min_(d[k] + step * along[k], limit), f = {}, down = splat(1.0f);
        for (int h = 0; h < 2; ++h) {
          V u = max_(c.u0[k] + B * x, splat(1e-30f)), p = exp_((c.n_s - 1.0f) * log_(u));
          f = c.n_s * p * B;
          down = 1.0f + f;
          V ratio = (x + s[k] + p * u - target[k]) / down, curve = (c.n_s - 1.0f) * f * B / u;
          x = min_(x - ratio / min_(max_(1.0f - 0.5f * ratio * curve / down, splat(0.5f)), splat(2.0f)), limit);
        }
        e[k] = x, turn[k] = -x * f / down;
      }
      cost = V{}, rise = V{};
      for (int j = 3; j < N; ++j) {
        const float* A = c.alpha[j];
        V y = A[0] * e[0] + A[1] * e[1] + A[2] * e[2], dy = A[0] * turn[0] + A[1] * turn[1] + A[2] * turn[2];
        V root = y + (A[0] * s[0] + A[1] * s[1] + A[2] * s[2]), u = c.u0[j] + B * y;
        V p = exp_((c.n_s - 1.0f) * log_(max_(u, splat(1e-30f)))), f = c.n_s * p * B;
        V r = max_(root, V{}) + p * max_(u, V{}) - image[j], t = choose(root > 0.0f, splat(1.0f), V{}) + f;
        cost += c.weight[j] * r * r, rise += c.weight[j] * r * (t * dy + f * y);
      }
      cost *= 0.5f;
    }
    I dip = (slope < 0.0f) & (rise >= 0.0f);
    V da = slope * step, db = rise * step;
    V t, lowest;
    if (opening) t = splat(1.0f), lowest = cost;
    else if (closing) t = splat(0.0f), lowest = old;
    else {
      V theta = da + db - 3.0f * (cost - old), q = max_(theta * theta - da * db, V{}), root;
      for (int l = 0; l < W; ++l) root[l] = std::sqrt(q[l]);
      t = min_(max_(1.0f - (db + root - theta) / max_(db - da + 2.0f * root, splat(1e-30f)), V{}), splat(1.0f));
      lowest = min_(min_(old, cost), max_(hermite(t, old, da, cost, db), V{}));
    }
    V place[5] = {lowest, log_b + (t - 1.0f) * step};
    for (int k = 0; k < 3; ++k) place[2 + k] = hermite(t, d[k], along[k] * step, e[k], turn[k] * step);
    for (int m = 0; m < MINIMA; ++m) {
      I lower = dip & (place[0] < best[m][0]);
      for (int k = 0; k < 5; ++k) {
        V kept = best[m][k];
        best[m][k] = choose(lower, place[k], kept), place[k] = choose(lower, kept, place[k]);
      }
    }
    for (int k = 0; k < 3; ++k) d[k] = e[k], along[k] = turn[k];
    old = cost, slope = rise;
  }
}

static inline void load(const float* image, const float* s, int64_t pixels, int64_t first, int count, V* im, V* root) {
  for (int j = 0; j < N; ++j) {
    im[j] = V{};
    std::memcpy(&im[j], image + j * pixels + first, 4 * count);
  }
  for (int k = 0; k < 3; ++k) {
    root[k] = V{};
    std::memcpy(&root[k], s + k * pixels + first, 4 * count);
  }
}

extern "C" int64_t whole_fit(
    int64_t pixels, const float* image, const float* s, const float* constants, const float* offsets, int32_t values,
    float tolerance, float floor, int32_t iterations, float* local, float* cost) {
  Shared c;
  std::memcpy(&c, constants, sizeof c);
  Stop stop{tolerance, floor, iterations};
  Lanes z = {};
  // Scanned vectors of pixels feed a queue of starts, from which the lanes are refilled.
  struct Start {
    int64_t pixel;
    float image[N], s[3], l[4];
  };
  static thread_local Start queue[W * MINIMA];
  int queued = 0, taken = 0, running = 0;
  int64_t at[W], next = 0, total = 0;
  for (int64_t i = 0; i < pixels; ++i) cost[i] = 3e38f;
  auto fill = [&]() {
    int count = pixels - next < W ? pixels - next : W;
    V im[N], root[3], best[MINIMA][5];
    load(image, s, pixels, next, count, im, root);
    scan(im, root, c, offsets, values, best);
    queued = taken = 0;
    for (int m = 0; m < MINIMA; ++m)
      for (int i = 0; i < count; ++i) {
        if (m && best[m][0][i] > 1e38f) continue;
        Start& q = queue[queued++];
        q.pixel = next + i;
        for (int j = 0; j < N; ++j) q.image[j] = im[j][i];
        for (int k = 0; k < 3; ++k) q.s[k] = root[k][i], q.l[k] = best[m][2 + k][i];
        q.l[3] = best[m][1][i];
      }
    next += count;
  };
  auto put = [&](int i) {
    if (taken == queued && next < pixels) fill();
    if (taken == queued) {
      z.live[i] = 0;
      return;
    }
    const Start& q = queue[taken++];
    at[i] = q.pixel;
    for (int j = 0; j < N; ++j) z.image[j][i] = q.image[j];
    for (int k = 0; k < 3; ++k) z.s[k][i] = q.s[k];
    for (int k = 0; k < 4; ++k) z.l[k][i] = q.l[k];
    z.cost[i] = 3e38f, z.fresh[i] = -1, z.live[i] = -1, z.count[i] = 0, z.mu[i] = 1.0f;
    ++running;
  };
  for (int i = 0; i < W; ++i) put(i);
  while (running) {
    I done = iterate(z, c, stop);
    uint32_t mask = 0;
    for (int i = 0; i < W; ++i) mask |= (done[i] & 1) << i;
    while (mask) {
      int i = __builtin_ctz(mask);
      mask &= mask - 1;
      if (z.cost[i] < cost[at[i]]) {
        for (int k = 0; k < 4; ++k) local[k * pixels + at[i]] = z.l[k][i];
        cost[at[i]] = z.cost[i];
      }
      total += z.count[i];
      --running;
      put(i);
    }
  }
  return total;
}

// ---------------------------------------------------------------- the joint fit: one pass over the pixels a shared step

static inline void pin(const V* l, V* g, V* v) {
  I held = ((l[3] <= LOW) & (g[3] > 0.0f)) | ((l[3] >= HIGH) & (g[3] < 0.0f));
  g[3] = choose(held, V{}, g[3]);
  for (int k : {3, 6, 8}) v[k] = choose(held, V{}, v[k]);
}

static inline Factor factorise_lightly(const V* v) {
  V damping[4];
  scales(v, damping);
  for (V& d : damping) d *= 20 * 1.1920929e-7f;
  return factorise(v, damping);
}

// Places follow `step` from the globals `old` to `now`, take two local iterations, and are reduced: sums receives the
// cost, S (ten) and the reduced gradient (four).
extern "C" void joint_pass(
    int64_t pixels, const float* image, const float* s, const float* old_constants, const float* new_constants,
    const float* step, float tolerance, float floor, const float* local, float* result, double* sums) {
  Shared before, now;
  std::memcpy(&before, old_constants, sizeof before), std::memcpy(&now, new_constants, sizeof now);
  Stop stop{tolerance, floor, 50};
  for (int i = 0; i < 15; ++i) sums[i] = 0;
  constexpr int64_t GROUP = 4;  // vectors summed in float32 before they are added up in float64
  for (int64_t group = 0; group < pixels; group += GROUP * W) {
    V part[15] = {};
    for (int64_t first = group; first < pixels && first < group + GROUP * W; first += W) {
      int count = pixels - first < W ? pixels - first : W;
      Lanes z = {};
      load(image, s, pixels, first, count, z.image, z.s);
      for (int k = 0; k < 4; ++k) std::memcpy(&z.l[k], local + k * pixels + first, 4 * count);
      for (int i = 0; i < count; ++i) z.live[i] = -1;
      Quadratic q;
      Cross x;
      V moved[4], pull[4];
      evaluate<true>(z.l, z.image, z.s, before, q, &x);
      pin(z.l, q.g, q.v);
      Factor f = factorise_lightly(q.v);
      for (int k = 0; k < 4; ++k)
        pull[k] = q.g[k] + x.w[k][0] * step[0] + x.w[k][1] * step[1] + x.w[k][2] * step[2] + x.w[k][3] * step[3];
      solve(f, pull[0], pull[1], pull[2], pull[3], moved);
      for (int k = 0; k < 4; ++k) moved[k] = z.l[k] - moved[k];
      moved[3] = min_(max_(moved[3], splat(LOW)), splat(HIGH));
      Quadratic go;
      evaluate<false>(z.l, z.image, z.s, now, z.q, nullptr);
      evaluate<false>(moved, z.image, z.s, now, go, nullptr);
      I better = less_(go.cost, z.q.cost);
      z.cost = choose(better, go.cost, z.q.cost), z.mu = splat(1e-3f);
      for (int k = 0; k < 4; ++k) z.l[k] = choose(better, moved[k], z.l[k]), z.q.g[k] = choose(better, go.g[k], z.q.g[k]);
      for (int k = 0; k < 10; ++k) z.q.v[k] = choose(better, go.v[k], z.q.v[k]);
      for (int i = 0; i < 2; ++i) z.live &= ~iterate(z, now, stop);
      evaluate<true>(z.l, z.image, z.s, now, q, &x);
      pin(z.l, q.g, q.v);
      f = factorise_lightly(q.v);
      I valid = I{};
      for (int i = 0; i < count; ++i) valid[i] = -1;
      V columns[4][4], own[4];
      for (int m = 0; m < 4; ++m) solve(f, x.w[0][m], x.w[1][m], x.w[2][m], x.w[3][m], columns[m]);
      solve(f, q.g[0], q.g[1], q.g[2], q.g[3], own);
      auto dot = [&](int m, const V* y) { return x.w[0][m] * y[0] + x.w[1][m] * y[1] + x.w[2][m] * y[2] + x.w[3][m] * y[3]; };
      int at = 0;
      part[at++] += choose(valid, q.cost, V{});
      for (int i = 0; i < 4; ++i)
        for (int m = i; m < 4; ++m, ++at) part[at] += choose(valid, x.h[at - 1] - dot(i, columns[m]), V{});
      for (int m = 0; m < 4; ++m) part[at++] += choose(valid, x.g[m] - dot(m, own), V{});
      for (int k = 0; k < 4; ++k) std::memcpy(result + k * pixels + first, &z.l[k], 4 * count);
    }
    for (int i = 0; i < 15; ++i)
      for (int lane = 0; lane < W; ++lane) sums[i] += part[i][lane];
  }
}
