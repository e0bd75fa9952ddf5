// The loop of core/solver.py and core/step.py for one template: see there for the reasons behind each step and constant.
#pragma once
#include "border.h"
#include "sums.h"

namespace ecc {

constexpr double INFINITE = HUGE_VAL;
constexpr int64_t BAND = 4 * BLOCK;  // rows that are sampled and summed together

struct State {
  double pose[3], distortion[4], delta[3] = {0, 0, 0}, length = 0, scale = 1, error = INFINITE;
  int64_t iterations = 0;
};

struct Settings {
  int64_t degree, max_iterations;
  double tolerance;
};

struct Scratch {  // of one thread, kept from call to call
  Window window;
  std::vector<float> patch, lines;  // (height, pitch), of the last look
  Border border;
  Model model;
  bool partial;  // whether pixels were out of its sight or not trusted

  const Weighted& weighted(const Pixels& p) const { return partial ? border.weighted : p.n->weighted; }
  Weights weights(const Pixels& p) const { return partial ? Weights{border.weight.data(), p.pitch} : p.weights; }
  Weights seen(const Pixels& p) const { return partial ? Weights{border.seen.data(), p.pitch} : p.weights; }
};

// Of pixel positions relative to the template's centre: R (I + D) x' + t, with R of eq. 2.
inline Warp warp_of(const State& state) {
  const double c = std::cos(state.pose[2]), s = std::sin(state.pose[2]), *const d = state.distortion;
  const double xu = 1 + d[0], xv = d[1], yu = d[2], yv = 1 + d[3];
  return {c * xu + s * yu, c * xv + s * yv, c * yu - s * xu, c * yv - s * xv, state.pose[0], state.pose[1]};
}

// Smallest rectangle around the warped template.
inline void bounds(const Pixels& p, const Warp& w, double (&low)[2], double (&high)[2]) {
  low[0] = low[1] = INFINITE;
  high[0] = high[1] = -INFINITE;
  for (int k = 0; k < 4; ++k) {
    const double x = p.n->left + (k % 2 ? double(p.width - 1) * p.step : 0);
    const double y = p.n->top + (k / 2 ? double(p.height - 1) * p.step : 0);
    const double point[2] = {w.x(x, y), w.y(x, y)};
    for (int d = 0; d < 2; ++d) {
      low[d] = std::min(low[d], point[d]);
      high[d] = std::max(high[d], point[d]);
    }
  }
}

// Brings the neighbourhood of the patch into the window, and weighs the template by what the frame shows of it. False if
// that is nothing, as of a pose that is not finite, which no place in memory could be made of.
template <int degree>
bool find(const Template& t, const Pixels& p, const Frame& frame, const Warp& warp, bool anew, Scratch& scratch) {
  double low[2], high[2];
  bounds(p, warp, low, high);
  scratch.partial = !(low[0] >= -ECC_ROUNDING && low[1] >= -ECC_ROUNDING && high[0] <= double(frame.w - 1) + ECC_ROUNDING &&
                      high[1] <= double(frame.h - 1) + ECC_ROUNDING);
  const bool somewhere = std::isfinite(low[0] + high[0] + low[1] + high[1]);  // not if a corner is no number
  scratch.partial = scratch.partial || !somewhere || p.trust;
  if (scratch.partial && !(somewhere && weigh(t, p, warp, frame, scratch.border))) return false;
  Window& window = scratch.window;
  const double first = degree / 2, last = (degree + 1) / 2;
  const bool covered = low[0] - first >= double(window.x0) && low[1] - first >= double(window.y0) &&
                       high[0] + last <= double(window.x0 + window.w - 1) &&
                       high[1] + last <= double(window.y0 + window.h - 1);
  if (anew || !covered) {
    place_window<degree>(low, high, degree == 1 ? 4 : 1, window);
    fill_window<degree>(frame, window);
  }
  return true;
}

// Samples the patch and adds up its products.
template <int degree>
void look(const Template& t, const Pixels& p, const Warp& warp, Scratch& scratch) {
  const Window& window = scratch.window;
  Warp there = warp;
  there.x0 -= double(window.x0 + degree / 2), there.y0 -= double(window.y0 + degree / 2);
  scratch.model = {};
  Model& m = scratch.model;
  for (int64_t first = 0; first < p.height; first += BAND) {
    const int64_t rows = std::min(BAND, p.height - first);
    float* const band = scratch.patch.data() + first * p.pitch;
    for (int64_t j = 0; j < rows; ++j) {
      const double u = p.n->left, v = p.n->top + double(first + j) * p.step;
      const Line line{float(there.x(u, v)), float(there.y(u, v)), float(there.xu * p.step), float(there.yu * p.step), int(p.width)};
      sample<degree>(window, line, band + j * p.pitch);
      fetch(p, first + BAND + j, degree == 1 ? 3 : 6);
    }
    if (first == 0) m.base = band[p.width / 2];  // sums lose little where little is left
    add_up(t, p, scratch.weights(p), first, rows, band, m, scratch.lines.data());
  }
  const double one = m.sums[4];
  for (int k = 0; k < t.lines(); ++k) m.sums[k] = m.sums[k] * rescaled(p, k)[0] + one * rescaled(p, k)[1];
}

inline Coefficients multiply(const Template& t, const Matrix& inverse, const Coefficients& sums) {
  Coefficients u{};
  for (int64_t i = 0; i < t.columns; ++i)
    for (int64_t j = 0; j < t.columns; ++j) u[i] += inverse[i][j] * sums[j];
  return u;
}

// Criterion.step and Criterion.fit.
inline void fit(const Template& t, const Pixels& p, const Weighted& w, Model& m) {
  Coefficients sums = m.sums;
  if (t.criterion >= 0) {
    m.fit = multiply(t, w.inverse, sums);
    for (int k = 0; k < 3; ++k) m.step[k] = m.fit[k] / std::max(m.fit[3], 0.0);
    return;
  }
  double gain = 1, offset = p.n->mean[1] - m.base;  // g = t
  if (t.criterion == PAPER) {                       // g less its mean, over t less its mean
    const double mean = sums[4] / w.total;
    gain = std::sqrt(std::max(m.square - mean * sums[4], 0.0)) / std::max(w.contrast, 1e-30);
    offset = mean - gain * w.along / w.total;
  }
  for (int k = 0; k < 3; ++k) sums[k] -= gain * w.of_t[k] + offset * w.of_one[k];
  m.fit = multiply(t, w.inverse, sums);
  for (int k = 0; k < 3; ++k) m.step[k] = m.fit[k] / gain;
  m.fit = {0, 0, 0, gain, offset};
}

// step.advance: accelerated step, update (eq. 10), predicted error.
inline void advance(double radius, const double (&step)[3], State& state) {
  const double delta[3] = {step[0], step[1], step[2] * radius}, last = state.length;
  double length = 0, along = 0;
  for (int k = 0; k < 3; ++k) {
    length += delta[k] * delta[k];
    along += state.delta[k] * delta[k];
  }
  length = std::sqrt(length);
  along /= last * last;
  const bool first = !std::isfinite(state.error);
  const double ratio = first && state.scale > 1 ? 1 - 1 / state.scale : last > 0 ? length / last : 0.5;
  const double rate = std::clamp(ratio, 0.05, 0.95);
  const bool usable = last < ECC_SECANT_RANGE && along < 0.9 && !first;
  const double secant = usable ? std::clamp(state.scale / (1 - along), 1.0, ECC_LARGEST_SCALE) : 1.0;
  const double scale = length > 0 ? std::min(secant, ECC_LONGEST_STEP * radius / length) : secant;
  state.pose[2] -= step[2] * scale;
  const double c = std::cos(state.pose[2]), s = std::sin(state.pose[2]);
  state.pose[0] -= (c * step[0] + s * step[1]) * scale;
  state.pose[1] -= (c * step[1] - s * step[0]) * scale;
  std::copy(delta, delta + 3, state.delta);
  state.length = length;
  state.scale = scale;
  state.error = length * scale * rate / (1 - rate);
  state.iterations += 1;
}

// solver.iterate. False if the last look saw nothing.
template <int degree>
bool iterate(const Template& t, const Pixels& p, const Frame& frame, double tolerance, int64_t most, State& state,
             Scratch& scratch) {
  state.error = INFINITE;
  for (int64_t row = 0; row < BAND; ++row) fetch(p, row, 3);
  for (bool anew = true; state.iterations < most && state.error > tolerance; anew = false) {
    const Warp warp = warp_of(state);
    Model& m = scratch.model;
    const bool seen = find<degree>(t, p, frame, warp, anew, scratch);
    if (seen) {
      look<degree>(t, p, warp, scratch);
      fit(t, p, scratch.weighted(p), m);
    }
    if (!seen || !(std::isfinite(m.step[0]) && std::isfinite(m.step[1]) && std::isfinite(m.step[2]))) {
      state.error = 0;
      return seen;
    }
    advance(p.n->radius, m.step, state);
  }
  return true;
}

// solver.solve_at_once. False if the last look saw nothing.
inline bool solve(const Template& t, const Frame& frame, const Settings& set, State& state, Scratch& scratch) {
  const int64_t most = set.max_iterations;
  scratch.patch.resize(t.whole.height * t.whole.pitch + LANES);
  scratch.lines.assign((MOST + SUMS + 3) * t.whole.line(), 0);
  scratch.border.of = nullptr;
  if (most > 1 && (set.degree > 1 || t.coarser)) {
    const double near = std::max(set.tolerance, ECC_COARSE_TOLERANCE);
    iterate<1>(t, t.coarser ? t.coarse : t.whole, frame, near, std::max<int64_t>(most * 2 / 3, 1), state, scratch);
  }
  if (set.degree == 1) return iterate<1>(t, t.whole, frame, set.tolerance, most, state, scratch);
  if (set.degree == 3) return iterate<3>(t, t.whole, frame, set.tolerance, most, state, scratch);
  return iterate<5>(t, t.whole, frame, set.tolerance, most, state, scratch);
}

}  // namespace ecc
