// The loop of torch_ecc/solver.py for one template: see there for the reasons behind each step and constant.
#pragma once
#include "template.h"

namespace ecc {

constexpr double COARSE_TOLERANCE = 0.02, SECANT_RANGE = 1.0, LARGEST_STRETCH = 5.0, LONGEST_STEP = 0.2;
constexpr double EDGE = 4, INFINITE = HUGE_VAL;
constexpr double MEMORY = 0.05, WORSE = 1.5, SLACK = 0.01;  // tracker.MEMORY, locate.AS_GOOD

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
  std::vector<float> patch, lines;  // the last sampled patch, (height, pitch), less the grey level `about`
  float about;
  Sums u;  // what the patch is made of: coefficients of the criterion's columns
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

// Of pixel positions relative to the template's centre.
inline Warp warp_of(const double (&pose)[3]) { return {std::cos(pose[2]), std::sin(pose[2]), pose[0], pose[1]}; }

// Smallest rectangle around the warped template.
inline void bounds(const Template& t, const Warp& w, double (&low)[2], double (&high)[2]) {
  low[0] = low[1] = INFINITE;
  high[0] = high[1] = -INFINITE;
  for (int k = 0; k < 4; ++k) {
    const double x = t.box[0][k] - t.centre[0], y = t.box[1][k] - t.centre[1];
    const double point[2] = {w.c * x + w.s * y + w.x0, w.c * y - w.s * x + w.y0};
    for (int d = 0; d < 2; ++d) {
      low[d] = std::min(low[d], point[d]);
      high[d] = std::max(high[d], point[d]);
    }
  }
}

// False for NaN, which compares as neither here nor there: no place in memory could be made of it.
inline bool inside(const Template& t, const double (&pose)[3], const Frame& frame, double margin) {
  double low[2], high[2];
  if (!std::isfinite(pose[0]) || !std::isfinite(pose[1]) || !std::isfinite(pose[2])) return false;
  bounds(t, warp_of(pose), low, high);
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

// Samples the patch and returns Z W v. The sums that serve do not feel the level v is counted from, but stay small.
template <int degree>
Sums look(const Template& t, const Pixels& p, const Warp& warp, Scratch& scratch) {
  const Window& window = scratch.window;
  const double x0 = warp.x0 - double(window.x0 + degree / 2), y0 = warp.y0 - double(window.y0 + degree / 2);
  Sums sums{};
  for (int64_t first = 0; first < p.height; first += BLOCK) {
    const int64_t rows = std::min(BLOCK, p.height - first);
    float* const band = scratch.patch.data() + first * p.pitch;
    fetch(t, p, p.z, first);
    for (int64_t j = 0; j < rows; ++j) {
      const double y = p.top + double(first + j) * p.step;
      sample<degree>(window,
                     {float(warp.c * p.left + warp.s * y + x0), float(warp.c * y - warp.s * p.left + y0),
                      float(warp.c * p.step), float(-warp.s * p.step), int(p.width)},
                     band + j * p.pitch);
    }
    if (first == 0) scratch.about = band[p.width / 2];
    for (int64_t i = 0; i < rows * p.pitch; ++i) band[i] -= scratch.about;
    products(t, p, first, rows, band, scratch.lines.data());
    add_lines(t, p, scratch.lines.data(), sums);
  }
  return sums;
}

// Coefficients of all columns (Criterion.fit) from Z W v and the patch, and of those the step (Criterion.step).
inline Sums coefficients(const Template& t, const Pixels& p, Sums sums, Scratch& scratch, double (&step)[3]) {
  if (t.criterion >= 0) {
    const Sums u = multiply(p, sums);
    for (int k = 0; k < 3; ++k) step[k] = u[k] / std::max(u[3], 0.0);
    return u;
  }
  Sums fit{0, 0, 0, 1, double(p.r.level) - scratch.about};  // v = t
  if (t.criterion == PAPER) {                               // v less its mean, over t less its mean
    double square = 0, w = p.of_one[4], wt = p.of_level[4];
    const float* weight = t.at<float>(p.weight);
    for (int64_t j = 0; j < p.height; ++j) {
      float sum = 0;
      const float* v = scratch.patch.data() + j * p.pitch;
      for (int64_t i = 0; i < p.width; ++i) sum += weight[j * p.weight_pitch + i] * v[i] * v[i];
      square += sum;
    }
    fit[3] = std::sqrt(std::max(square - sums[4] * sums[4] / w, 0.0)) / std::max(p.contrast, 1e-30);
    fit[4] = sums[4] / w - fit[3] * wt / w;
  }
  for (int k = 0; k < 5; ++k) sums[k] -= fit[3] * p.of_level[k] + fit[4] * p.of_one[k];
  const Sums u = multiply(p, sums);
  for (int k = 0; k < 3; ++k) step[k] = u[k] / fit[3];
  return fit;
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
void iterate(const Template& t, const Pixels& p, const Frame& frame, double tolerance, int64_t budget, State& state,
             Scratch& scratch) {
  state.error = INFINITE;
  for (int64_t k = 0; k < budget && state.error > tolerance; ++k) {
    const Warp warp = warp_of(state.pose);
    cover<degree>(t, frame, warp, scratch.window, k == 0);
    double step[3];
    scratch.u = coefficients(t, p, look<degree>(t, p, warp, scratch), scratch, step);
    if (std::isfinite(step[0]) && std::isfinite(step[1]) && std::isfinite(step[2])) {
      advance(t, step, state);
    } else {
      state.error = 0;
    }
  }
}

// solver.refine. False, with nothing settled, if the template comes so near the frame's border that pixels may drop out.
inline bool refine(const Template& t, const Frame& frame, const Settings& set, State& state, Scratch& scratch) {
  int64_t budget = set.max_iterations;
  scratch.patch.resize(t.whole.height * t.whole.pitch + LANES);
  scratch.lines.resize((MOST + BLOCK + 1) * t.whole.pitch + LANES);
  if (!inside(t, state.pose, frame, EDGE)) return false;
  if (budget > 1 && (set.degree > 1 || t.thin.step > 1)) {
    const int64_t coarse = std::max<int64_t>(budget * 2 / 3, 1);
    iterate<1>(t, t.thin, frame, std::max(set.tolerance, COARSE_TOLERANCE), coarse, state, scratch);
    budget -= coarse;
    if (!inside(t, state.pose, frame, EDGE)) return false;
  }
  if (set.degree == 1) iterate<1>(t, t.whole, frame, set.tolerance, budget, state, scratch);
  if (set.degree == 3) iterate<3>(t, t.whole, frame, set.tolerance, budget, state, scratch);
  if (set.degree == 5) iterate<5>(t, t.whole, frame, set.tolerance, budget, state, scratch);
  return inside(t, state.pose, frame, 0);
}

}  // namespace ecc
