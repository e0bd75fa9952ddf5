// The loop of torch_ecc/solver.py for one template: see there for the reasons behind each step and constant.
#pragma once
#include <numeric>

#include "template.h"

namespace ecc {

constexpr double COARSE_TOLERANCE = 0.02, SECANT_RANGE = 1.0, LARGEST_STRETCH = 5.0, LONGEST_STEP = 0.2;
constexpr double CLEAR = 0.2;  // share of what is left of a patch
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

struct Scratch {  // of one thread, kept from call to call; all but the window is of the last patch sampled
  Window window;
  std::vector<float> patch, lines;  // (height, pitch); (rows of blocks, lines_of, pitch), if it is of a whole template
  std::vector<float> rest;          // room for three lines, and three of blocks
  Coefficients model, change;       // what its sums count from, and what its fit has more of each column
  Sums sums;

  double gain() const { return model[3] + change[3]; }
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

// What the patch is likely made of, after an earlier look if there was one: where little is left, sums lose little.
inline Coefficients expected(const Template& t, const Scratch& scratch, bool whole, bool anew) {
  Coefficients model{0, 0, 0, 0, scratch.patch[(whole ? t.whole : t.thin).width / 2]};
  if (whole && t.criterion == SSD) model = {0, 0, 0, 1, t.whole.level};
  if (whole && t.criterion != SSD && !anew && scratch.gain() > 0 && scratch.gain() < INFINITE)
    for (int k = 3; k < MOST; ++k) model[k] = scratch.model[k] + scratch.change[k];
  return model;
}

// Samples the patch and adds up its products.
template <int degree, bool whole>
void look(const Template& t, const Warp& warp, bool anew, Scratch& scratch) {
  const Pixels& p = whole ? t.whole : t.thin;
  const Window& window = scratch.window;
  const double x0 = warp.x0 - double(window.x0 + degree / 2), y0 = warp.y0 - double(window.y0 + degree / 2);
  float* lines = scratch.lines.data();
  scratch.sums = {};
  for (int64_t first = 0; first < p.height; first += BLOCK) {
    const int64_t rows = std::min(BLOCK, p.height - first);
    float* const band = scratch.patch.data() + first * p.pitch;
    for (int64_t j = 0; j < rows; ++j) {
      const double y = p.top + double(first + j) * p.step;
      sample<degree>(window,
                     {float(warp.c * p.left + warp.s * y + x0), float(warp.c * y - warp.s * p.left + y0),
                      float(warp.c * p.step), float(-warp.s * p.step), int(p.width)},
                     band + j * p.pitch);
      fetch(t, p, first + BLOCK + j);
    }
    if (first == 0) scratch.model = expected(t, scratch, whole, anew);
    products<whole>(t, p, first, rows, band, scratch.model, lines);
    add_lines(t, p, lines, scratch.sums);
    if (whole) lines += lines_of(t) * p.pitch;
  }
}

// What the fit (Criterion.fit) has more of each column than the model, and the step (Criterion.step).
inline void fit(const Template& t, const Pixels& p, Scratch& scratch, double (&step)[3]) {
  const Coefficients& model = scratch.model;
  Coefficients sums = scratch.sums.z, &change = scratch.change;
  if (t.criterion >= 0) {
    change = multiply(p, sums);
    for (int k = 0; k < 3; ++k) step[k] = change[k] / std::max(scratch.gain(), 0.0);
    return;
  }
  double gain = 1, one = t.whole.level;  // v = t
  if (t.criterion == PAPER) {            // v less its mean, over t less its mean
    const double w = p.of_one[4], wt = p.of_level[4], mean = sums[4] / w, known = model[3] * p.contrast;
    const double both = scratch.sums.r[3] * p.grey - mean * wt;  // what the model leaves, less its mean, times t
    const double square = scratch.sums.squares - mean * sums[4] + 2 * model[3] * both + known * known;
    gain = std::sqrt(std::max(square, 0.0)) / std::max(p.contrast, 1e-30);
    one = model[4] + mean - (gain - model[3]) * wt / w;
  }
  change = {0, 0, 0, gain - model[3], one - model[4]};
  for (int k = 0; k < 3; ++k) sums[k] -= change[3] * p.of_level[k] + change[4] * p.of_one[k];
  const Coefficients moved = multiply(p, sums);
  for (int k = 0; k < 3; ++k) step[k] = moved[k] / gain;
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
  // A first step after another stage is not the next of a series: what share of its way a step covers is known.
  const bool first = !std::isfinite(state.error);
  const double ratio = first && state.factor > 1 ? 1 - 1 / state.factor : last > 0 ? length / last : 0.5;
  const double rate = std::clamp(ratio, 0.05, 0.95);
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

// R W R^T u, and R W r, from the column t on, of the last look at a whole template.
inline double along(const Template& t, int c, const Coefficients& u) {
  return std::inner_product(u.begin(), u.end(), t.gram[c], 0.0);
}

inline double along(const Template& t, int c, const Sums& sums) { return c == 4 ? sums.z[4] : sums.r[c] * t.whole.grey; }

// e W e of e = r - R^T change. What e has along G is nothing but chance, as it is nothing along Z; along the other
// columns it is known. `moved`: the step's part of R^T change alone, squared.
inline double left_over(const Template& t, const Scratch& scratch, double& moved) {
  double rest = scratch.sums.squares;
  moved = 0;
  for (int c = 0; c < MOST; ++c) {
    const double taken = along(t, c, scratch.change);
    rest -= scratch.change[c] * (c < 3 ? taken : 2 * along(t, c, scratch.sums) - taken);
    if (c < 3) moved += scratch.change[c] * taken;
  }
  return std::max(rest, CLEAR * moved);  // never nothing for certain, after a long step
}

// Whether chance may be much of what is left: in frames with next to no noise, after a step that is not small.
inline bool vague(const Template& t, const Scratch& scratch) {
  double moved;
  return CLEAR * left_over(t, scratch, moved) < moved;
}

template <int degree, bool whole>
void iterate(const Template& t, const Frame& frame, double tolerance, int64_t budget, bool last, State& state,
             Scratch& scratch) {
  const Pixels& p = whole ? t.whole : t.thin;
  state.error = INFINITE;
  for (int64_t row = 0; row < BLOCK; ++row) fetch(t, p, row);
  for (int64_t k = 0; k < budget && (state.error > tolerance || (last && vague(t, scratch))); ++k) {
    const Warp warp = warp_of(state.pose);
    cover<degree>(t, frame, warp, scratch.window, k == 0);
    look<degree, whole>(t, warp, state.iterations == 0, scratch);
    double step[3];
    fit(t, p, scratch, step);
    if (!(std::isfinite(step[0]) && std::isfinite(step[1]) && std::isfinite(step[2]))) {
      state.error = 0;
      break;
    }
    advance(t, step, state);
  }
}

// solver.refine. False, with nothing settled, if the template comes so near the frame's border that pixels may drop out.
inline bool refine(const Template& t, const Frame& frame, const Settings& set, State& state, Scratch& scratch) {
  int64_t budget = set.max_iterations;
  scratch.patch.resize(t.whole.height * t.whole.pitch + LANES);
  scratch.lines.resize(rows_of_blocks(t.whole) * lines_of(t) * t.whole.pitch);
  scratch.rest.assign(3 * (t.whole.pitch + BLOCK + t.parts_pitch), 0);
  scratch.model = scratch.change = {};
  if (!inside(t, state.pose, frame, EDGE)) return false;
  if (budget > 1 && (set.degree > 1 || t.thinned)) {
    const int64_t coarse = std::max<int64_t>(budget * 2 / 3, 1);
    const double near = std::max(set.tolerance, COARSE_TOLERANCE);
    if (t.thinned)
      iterate<1, false>(t, frame, near, coarse, false, state, scratch);
    else
      iterate<1, true>(t, frame, near, coarse, false, state, scratch);
    budget -= coarse;
    if (!inside(t, state.pose, frame, EDGE)) return false;
  }
  if (set.degree == 1) iterate<1, true>(t, frame, set.tolerance, budget, true, state, scratch);
  if (set.degree == 3) iterate<3, true>(t, frame, set.tolerance, budget, true, state, scratch);
  if (set.degree == 5) iterate<5, true>(t, frame, set.tolerance, budget, true, state, scratch);
  return inside(t, state.pose, frame, 0);
}

}  // namespace ecc
