// Templates of which the frame shows only a part: pixels out of sight weigh nothing, and what depends on the weights is
// made anew (core/reference.py: reweigh, Moments).
#pragma once
#include <algorithm>

#include "template.h"

namespace ecc {

struct Moments {  // reference.Moments
  double count;
  Matrix normal, power;
  double gram[4][4], noise[2][4];
};

struct Border {  // what is known of the visible pixels `of` a template
  const Pixels* of = nullptr;
  std::vector<float> weight, before, column;  // (height, pitch)
  std::vector<float> lines;
  Moments moments;
  Weighted weighted;
};

// criteria.safe_inverse by Gauss-Jordan, with rows and columns brought to unit diagonal; zero if singular to float32.
inline void invert(Matrix& matrix, int64_t n) {
  double scale[MOST], wide[MOST][2 * MOST] = {};
  for (int64_t i = 0; i < n; ++i) scale[i] = 1 / std::sqrt(std::max(std::abs(matrix[i][i]), 1e-30));
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t j = 0; j < n; ++j) wide[i][j] = matrix[i][j] * scale[i] * scale[j];
    wide[i][n + i] = 1;
  }
  for (int64_t k = 0; k < n; ++k) {
    int64_t best = k;
    for (int64_t i = k; i < n; ++i)
      if (std::abs(wide[i][k]) > std::abs(wide[best][k])) best = i;
    std::swap(wide[k], wide[best]);
    const double pivot = wide[k][k];
    for (double& value : wide[k]) value /= pivot;
    for (int64_t i = 0; i < n; ++i)
      for (int64_t j = 2 * n - 1; i != k && j >= k; --j) wide[i][j] -= wide[i][k] * wide[k][j];
  }
  double size = 0;
  bool regular = true;
  for (int64_t i = 0; i < n; ++i) {
    regular = regular && matrix[i][i] > 0;
    for (int64_t j = 0; j < n; ++j) size += std::abs(wide[i][n + j]);
  }
  regular = regular && size < 1e6;  // NaN and infinity compare as singular
  for (int64_t i = 0; i < MOST; ++i)
    for (int64_t j = 0; j < MOST; ++j) matrix[i][j] = regular && i < n && j < n ? wide[i][n + j] * scale[i] * scale[j] : 0;
}

// Z W v of a whole template.
inline Coefficients project(const Template& t, const Pixels& p, const Weights& w, const float* v, Border& b) {
  Coefficients sums{};
  double square = 0;
  b.lines.resize(size_t(t.lines() + 1) * p.line());
  add_products(t, p, w, 0, p.height, v, 0, b.lines.data(), sums, square);
  rescale(t, p, sums);
  return sums;
}

// Weights of the pixels that the warp puts inside the frame, and what follows from them for the loop. False if none is.
inline bool weigh(const Template& t, const Pixels& p, const Warp& warp, const Frame& frame, Border& b) {
  b.before.swap(b.weight);
  b.weight.resize(p.height * p.pitch);
  const double right = double(frame.w - 1) + ECC_ROUNDING, bottom = double(frame.h - 1) + ECC_ROUNDING;
  float any = 0;
  for (int64_t j = 0; j < p.height; ++j) {
    const double py = p.n->top + double(j) * p.step, x0 = warp.x0 + warp.s * py, y0 = warp.y0 + warp.c * py;
    const float* const of = p.weights.at + j * p.weights.pitch;
    float* const to = b.weight.data() + j * p.pitch;
    for (int64_t i = 0; i < p.pitch; ++i) {
      const double px = p.n->left + double(i) * p.step, x = x0 + warp.c * px, y = y0 - warp.s * px;
      to[i] = x >= -ECC_ROUNDING && x <= right && y >= -ECC_ROUNDING && y <= bottom ? of[i] : 0;
      any = std::max(any, to[i]);
    }
  }
  if (!(any > 0)) return false;
  if (b.of == &p && b.before == b.weight) return true;
  b.of = &p;
  const Weights w{b.weight.data(), p.pitch};
  b.column.resize(p.height * p.pitch);
  Weighted& out = b.weighted;
  for (int k = 0; k < t.lines(); ++k) {
    column(p, 1, k, b.column.data());
    const Coefficients sums = project(t, p, w, b.column.data(), b);
    for (int j = 0; j < MOST; ++j) b.moments.normal[j][k] = sums[j];
    for (int j = 0; j < 3 && (k == 3 || k == 4); ++j) (k == 3 ? out.of_t : out.of_one)[j] = sums[j];
  }
  std::copy_n(&b.moments.normal[0][0], MOST * MOST, &out.inverse[0][0]);
  invert(out.inverse, t.columns);
  double total = 0, along = 0, square = 0;
  column(p, 1, 3, b.column.data());
  for (int64_t i = 0; i < p.height * p.pitch; ++i) {
    const double w = b.weight[i], v = b.column[i];
    total += w;
    along += w * v;
    square += w * v * v;
  }
  out.total = total;
  out.along = along;
  out.contrast = std::sqrt(std::max(square - along * along / total, 0.0));
  return true;
}

// Adds the row j to count, gram and noise.
inline void add_row(const Pixels& p, int64_t j, const Border& b, Moments& m) {
  const float *const weight = b.weight.data() + j * p.pitch, *const of_t = b.column.data() + j * p.pitch;
  const int16_t* const wiener = p.plane(WIENER) + j * p.pitch;
  float n = 0, w0 = 0, w1 = 0, w2 = 0, t0 = 0, t1 = 0, tt = 0, q0 = 0, q1 = 0, q2 = 0, s0 = 0, s1 = 0, s2 = 0;
  const float left = float(p.n->left), step = float(p.step);
  for (int64_t i = 0; i < p.pitch; ++i) {
    const float w = weight[i], x = left + float(i) * step, t = of_t[i], q = w * (wiener[i] * (1.f / ECC_LEVELS));
    n += w > 0 ? 1.f : 0.f;
    w0 += w;
    w1 += w * x;
    w2 += w * x * x;
    t0 += w * t;
    t1 += w * t * x;
    tt += w * t * t;
    q0 += q;
    q1 += q * x;
    q2 += q * x * x;
    s0 += q * q;
    s1 += q * q * x;
    s2 += q * q * x * x;
  }
  const double y = p.n->top + double(j) * p.step, v = y / p.n->half[1], u = 1 / p.n->half[0];
  const double rows[4][4] = {{w0, w1 * u, w0 * v, t0}, {0, w2 * u * u, w1 * u * v, t1 * u}, {0, 0, w0 * v * v, t0 * v}, {0, 0, 0, tt}};
  const double arms[2][4] = {{q0, q1, q0 * y, q2 + q0 * y * y}, {s0, s1, s0 * y, s2 + s0 * y * y}};
  m.count += n;
  for (int k = 0; k < 4; ++k) {
    for (int l = k; l < 4; ++l) m.gram[k][l] += rows[k][l];
    for (int s = 0; s < 2; ++s) m.noise[s][k] += arms[s][k];
  }
}

// The other moments of the weights that are in force.
inline void complete(const Template& t, const Pixels& p, Border& b) {
  Moments& m = b.moments;
  const Weights w{b.weight.data(), p.pitch};
  for (int k = 0; k < t.columns; ++k) {
    column(p, 0, k, b.column.data());
    for (int64_t i = 0; i < p.height * p.pitch; ++i) b.column[i] *= b.weight[i];
    const Coefficients sums = project(t, p, w, b.column.data(), b);
    for (int j = 0; j < MOST; ++j) m.power[j][k] = sums[j];
  }
  m.count = 0;
  std::fill_n(&m.gram[0][0], 16, 0.0);
  std::fill_n(&m.noise[0][0], 8, 0.0);
  column(p, 1, 3, b.column.data());
  for (int64_t j = 0; j < p.height; ++j) add_row(p, j, b, m);
  for (int k = 0; k < 4; ++k)
    for (int l = 0; l < k; ++l) m.gram[k][l] = m.gram[l][k];
}

}  // namespace ecc
