// Ceres on the same pixels from the same starts, closed-form Jacobians, double precision: pixel by pixel with its
// general solver and with its TinySolver, and all pixels with the globals by its Schur complement.
#include <ceres/ceres.h>
#include <ceres/tiny_solver.h>

#include <cmath>
#include <cstdint>
#include <vector>

#ifndef LIGHTS
#define LIGHTS 6
#endif
constexpr int N = LIGHTS;

struct Pixel {
  double image[N], s[3];
  const double* c;  // alpha (N, 3), A a (N), lambda (N), n_s, a (3)

  // Residuals, and derivatives by l (N, 4) and by (a, n_s) (N, 4), row major; null where not wanted.
  bool evaluate(const double* l, const double* g, double* r, double* J, double* K) const {
    double B = std::exp(l[3]);
    if (!(B < 1e12)) return false;
    for (int j = 0; j < N; ++j) {
      const double* A = c + 3 * j;
      double w = std::sqrt(c[4 * N + j]), y = A[0] * l[0] + A[1] * l[1] + A[2] * l[2];
      double x = y + A[0] * s[0] + A[1] * s[1] + A[2] * s[2], u = A[0] * g[0] + A[1] * g[1] + A[2] * g[2] + B * y;
      double p = u > 0 ? std::pow(u, g[3] - 1) : 0, f = g[3] * p * B, q = (x > 0) + f;
      r[j] = w * (std::fmax(x, 0.0) + p * std::fmax(u, 0.0) - image[j]);
      for (int k = 0; k < 3; ++k) {
        if (J) J[4 * j + k] = w * A[k] * q;
        if (K) K[4 * j + k] = w * A[k] * g[3] * p;
      }
      if (!std::isfinite(r[j] * f)) return false;
      if (J) J[4 * j + 3] = w * f * y;
      if (K) K[4 * j + 3] = u > 0 ? w * p * u * std::log(u) : 0;
    }
    return true;
  }
};

struct Local : ceres::SizedCostFunction<N, 4> {
  explicit Local(const Pixel* p, const double* g) : p(p), g(g) {}
  bool Evaluate(double const* const* x, double* r, double** J) const override {
    return p->evaluate(x[0], g, r, J ? J[0] : nullptr, nullptr);
  }
  const Pixel* p;
  const double* g;
};

struct Joint : ceres::SizedCostFunction<N, 4, 4> {
  explicit Joint(const Pixel* p) : p(p) {}
  bool Evaluate(double const* const* x, double* r, double** J) const override {
    return p->evaluate(x[0], x[1], r, J ? J[0] : nullptr, J ? J[1] : nullptr);
  }
  const Pixel* p;
};

struct Tiny {
  typedef double Scalar;
  enum { NUM_RESIDUALS = N, NUM_PARAMETERS = 4 };
  const Pixel* p;
  const double* g;
  bool operator()(const double* x, double* r, double* J) const {
    double rows[4 * N];
    p->evaluate(x, g, r, J ? rows : nullptr, nullptr);
    for (int j = 0; J && j < N; ++j)
      for (int k = 0; k < 4; ++k) J[k * N + j] = rows[4 * j + k];  // column major
    return true;
  }
};

static std::vector<Pixel> pixels_of(int64_t n, const double* image, const double* s, const double* c) {
  std::vector<Pixel> pixels(n);
  for (int64_t i = 0; i < n; ++i) {
    for (int j = 0; j < N; ++j) pixels[i].image[j] = image[j * n + i];
    for (int k = 0; k < 3; ++k) pixels[i].s[k] = s[k * n + i];
    pixels[i].c = c;
  }
  return pixels;
}

// local: (n, 4), in and out; shared: (a_1, a_2, a_3, n_s).
extern "C" void ceres_local(int64_t n, const double* image, const double* s, const double* c, const double* shared,
                            double tolerance, int32_t iterations, double* local) {
  auto pixels = pixels_of(n, image, s, c);
  ceres::Solver::Options o;
  o.linear_solver_type = ceres::DENSE_NORMAL_CHOLESKY;
  o.max_num_iterations = iterations, o.function_tolerance = tolerance, o.logging_type = ceres::SILENT;
  for (int64_t i = 0; i < n; ++i) {
    ceres::Problem problem;
    problem.AddResidualBlock(new Local(&pixels[i], shared), nullptr, local + 4 * i);
    ceres::Solver::Summary summary;
    ceres::Solve(o, &problem, &summary);
  }
}

extern "C" void ceres_tiny(int64_t n, const double* image, const double* s, const double* c, const double* shared,
                           double tolerance, int32_t iterations, double* local) {
  auto pixels = pixels_of(n, image, s, c);
  ceres::TinySolver<Tiny> solver;
  solver.options.max_num_iterations = iterations, solver.options.cost_threshold = 1e-12;
  solver.options.parameter_tolerance = 1e-6, solver.options.gradient_tolerance = 1e-9;
  solver.options.function_tolerance = tolerance;
  for (int64_t i = 0; i < n; ++i) {
    Eigen::Matrix<double, 4, 1> x(local + 4 * i);
    solver.Solve(Tiny{&pixels[i], shared}, &x);
    for (int k = 0; k < 4; ++k) local[4 * i + k] = x[k];
  }
}

extern "C" int32_t ceres_joint(int64_t n, const double* image, const double* s, const double* c, double* shared,
                               double tolerance, int32_t iterations, double* local) {
  auto pixels = pixels_of(n, image, s, c);
  ceres::Problem problem;
  auto* ordering = new ceres::ParameterBlockOrdering;
  for (int64_t i = 0; i < n; ++i) {
    problem.AddResidualBlock(new Joint(&pixels[i]), nullptr, local + 4 * i, shared);
    ordering->AddElementToGroup(local + 4 * i, 0);
  }
  ordering->AddElementToGroup(shared, 1);
  ceres::Solver::Options o;
  o.linear_solver_type = ceres::DENSE_SCHUR, o.linear_solver_ordering.reset(ordering);
  o.max_num_iterations = iterations, o.function_tolerance = tolerance, o.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(o, &problem, &summary);
  return summary.iterations.size();
}
