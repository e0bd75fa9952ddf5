// The loop of torch_ecc/solver.py for one template: see there for the reasons behind each step and constant.
#pragma once
#include "sample.h"

namespace ecc {

constexpr double COARSE_TOLERANCE = 0.02, SECANT_RANGE = 1.0, LARGEST_STRETCH = 5.0, LONGEST_STEP = 0.2;
constexpr double EDGE = 4, INFINITE = HUGE_VAL;
constexpr double MEMORY = 0.05, WORSE = 1.5, SLACK = 0.01;  // tracker.MEMORY, locate.AS_GOOD
constexpr int SSD = -1;  // in place of a number of light columns

struct Template {  // one template of torch_ecc.Reference: N pixels, p columns
  int64_t n, p, blocks;
  int light;  // columns of light beside t, or SSD
  const float *px, *py, *K, *signal, *level, *weight;  // level: the grey levels, after G in signal
  double box[2][4], centre[2], radius, noise, noise_share;
  const double *alias, *slope, *spread, *inflation, *spread_noise;
};

struct State {
  double pose[3], delta[3] = {0, 0, 0}, factor = 1, error = INFINITE;
  int64_t iterations = 0;
};

struct Settings {
  int64_t degree, max_iterations;
  double tolerance, min_score;
};

struct Scratch {  // of one thread, kept from call to call
  Window window;
  std::vector<float> patch, lines;
  double u[4];  // K's first rows times the patch
};

// pose.compose, and pose.compose(pose.inverse(a), b).
inline void compose(const double* a, const double* b, double* out) {
  const double c = std::cos(a[2]), s = std::sin(a[2]);
  out[0] = a[0] + c * b[0] + s * b[1];
  out[1] = a[1] + c * b[1] - s * b[0];
  out[2] = a[2] + b[2];
}

inline void between(const double* a, const double* b, double* out) {
  const double c = std::cos(a[2]), s = std::sin(a[2]), x = b[0] - a[0], y = b[1] - a[1];
  out[0] = c * x - s * y;
  out[1] = s * x + c * y;
  out[2] = b[2] - a[2];
}

inline Warp warp_of(const Template& t, const double (&pose)[3]) {
  const double c = std::cos(pose[2]), s = std::sin(pose[2]);
  return {c, s, pose[0] - c * t.centre[0] - s * t.centre[1], pose[1] + s * t.centre[0] - c * t.centre[1]};
}

// Smallest rectangle around the warped template.
inline void bounds(const Template& t, const Warp& w, double (&low)[2], double (&high)[2]) {
  low[0] = low[1] = INFINITE;
  high[0] = high[1] = -INFINITE;
  for (int k = 0; k < 4; ++k) {
    const double point[2] = {w.c * t.box[0][k] + w.s * t.box[1][k] + w.x0, w.c * t.box[1][k] - w.s * t.box[0][k] + w.y0};
    for (int d = 0; d < 2; ++d) {
      low[d] = std::min(low[d], point[d]);
      high[d] = std::max(high[d], point[d]);
    }
  }
}

inline bool inside(const Template& t, const double (&pose)[3], const Frame& frame, double margin) {
  double low[2], high[2];
  bounds(t, warp_of(t, pose), low, high);
  return low[0] >= margin && low[1] >= margin && high[0] <= double(frame.w - 1) - margin &&
         high[1] <= double(frame.h - 1) - margin;
}

template <int degree>
void cover(const Template& t, const Frame& frame, const Warp& warp, Window& window, bool anew) {
  double low[2], high[2];
  bounds(t, warp, low, high);
  const double first = degree / 2, last = (degree + 1) / 2;
  const bool covered = low[0] - first >= double(window.x0) && low[1] - first >= double(window.y0) &&
                       high[0] + last <= double(window.x0 + window.w - 1) &&
                       high[1] + last <= double(window.y0 + window.h - 1);
  if (anew || !covered) open_window<degree>(frame, low, high, degree == 1 ? 4 : 1, window);
}

// Samples the patch and returns K_r g of the first rows, g less the template (SSD) or less a grey level near its mean:
// the rows of K that serve are orthogonal to a constant, but the sums should stay small.
template <int degree, int rows, bool ssd>
void project(const Template& t, const Warp& warp, const Window& window, float* patch, double (&u)[rows]) {
  std::fill(u, u + rows, 0.0);
  float about = 0;
  for (int64_t first = 0; first < t.n; first += CHUNK) {
    const int n = int(std::min<int64_t>(CHUNK, t.n - first));
    float* g = patch + first;
    sample<degree>(window, warp, t.px + first, t.py + first, n, g);
    if (first == 0) about = g[n / 2];
    const float *K = t.K + first, *level = t.level + first;
    float sum[rows] = {};
    for (int i = 0; i < n; ++i) {
      const float v = g[i] - (ssd ? level[i] : about);
      for (int r = 0; r < rows; ++r) sum[r] += K[r * t.n + i] * v;
    }
    for (int r = 0; r < rows; ++r) u[r] += sum[r];
  }
}

// Criterion.step: false if the patch asks for no finite step.
template <int degree>
bool increment(const Template& t, const Warp& warp, Scratch& scratch, double (&step)[3]) {
  if (t.light == SSD) {
    project<degree, 3, true>(t, warp, scratch.window, scratch.patch.data(), step);
  } else {
    double(&u)[4] = scratch.u;
    project<degree, 4, false>(t, warp, scratch.window, scratch.patch.data(), u);
    for (int k = 0; k < 3; ++k) step[k] = u[k] / std::max(u[3], 0.0);
  }
  return std::isfinite(step[0]) && std::isfinite(step[1]) && std::isfinite(step[2]);
}

// solver.gauss_newton after the step is known: secant stretch, update (eq. 10), predicted error.
inline void advance(const Template& t, const double (&step)[3], State& state) {
  const double delta[3] = {step[0], step[1], step[2] * t.radius};
  double length = 0, last = 0, along = 0;
  for (int k = 0; k < 3; ++k) {
    length += delta[k] * delta[k];
    last += state.delta[k] * state.delta[k];
    along += state.delta[k] * delta[k];
  }
  length = std::sqrt(length);
  last = std::sqrt(last);
  const double rate = std::clamp(last > 0 ? length / last : 0.5, 0.05, 0.95);
  along /= last * last;
  const bool usable = last < SECANT_RANGE && along < 0.9 && std::isfinite(state.error);
  const double factor = usable ? std::clamp(state.factor / (1 - along), 1.0, LARGEST_STRETCH) : 1.0;
  const double stretch = std::min(factor, LONGEST_STEP * t.radius / std::max(length, 1e-12));
  state.pose[2] -= step[2] * stretch;
  const double c = std::cos(state.pose[2]), s = std::sin(state.pose[2]);
  state.pose[0] -= (c * step[0] + s * step[1]) * stretch;
  state.pose[1] -= (c * step[1] - s * step[0]) * stretch;
  std::copy(delta, delta + 3, state.delta);
  state.factor = stretch;
  state.error = length * stretch * rate / (1 - rate);
  state.iterations += 1;
}

template <int degree>
void iterate(const Template& t, const Frame& frame, double tolerance, int64_t budget, State& state, Scratch& scratch) {
  state.error = INFINITE;
  for (int64_t k = 0; k < budget && state.error > tolerance; ++k) {
    const Warp warp = warp_of(t, state.pose);
    cover<degree>(t, frame, warp, scratch.window, k == 0);
    double step[3];
    if (increment<degree>(t, warp, scratch, step)) {
      advance(t, step, state);
    } else {
      state.error = 0;
    }
  }
}

// What the first iterations use of a template: its sparse pixels, gathered.
struct Thin {
  std::vector<float> px, py, level;
  Template t;

  // sparse (n), K (p, n) of torch_ecc.Reference
  void gather(const Template& whole, const int64_t* sparse, int64_t n, const float* K) {
    t = whole;
    for (auto [to, from] : {std::pair{&px, whole.px}, {&py, whole.py}, {&level, whole.level}}) {
      to->resize(n);
      for (int64_t i = 0; i < n; ++i) (*to)[i] = from[sparse[i]];
    }
    t.n = n;
    t.K = K;
    t.px = px.data();
    t.py = py.data();
    t.level = level.data();
  }
};

// solver.refine. False, with nothing settled, if the template comes so near the frame's border that pixels may drop out.
inline bool refine(const Template& t, const Template& thin, const Frame& frame, const Settings& set, State& state, Scratch& scratch) {
  int64_t budget = set.max_iterations;
  scratch.patch.resize(t.n);
  if (!inside(t, state.pose, frame, EDGE)) return false;
  if (budget > 1 && (set.degree > 1 || thin.n < t.n)) {
    const int64_t coarse = std::max<int64_t>(budget * 2 / 3, 1);
    iterate<1>(thin, frame, std::max(set.tolerance, COARSE_TOLERANCE), coarse, state, scratch);
    budget -= coarse;
    if (!inside(t, state.pose, frame, EDGE)) return false;
  }
  if (set.degree == 1) iterate<1>(t, frame, set.tolerance, budget, state, scratch);
  if (set.degree == 3) iterate<3>(t, frame, set.tolerance, budget, state, scratch);
  if (set.degree == 5) iterate<5>(t, frame, set.tolerance, budget, state, scratch);
  return inside(t, state.pose, frame, 0);
}

}  // namespace ecc
