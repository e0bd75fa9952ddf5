// Templates of which the frame shows only a part, or blocks are not trusted: pixels count less or nothing, and what
// depends on the weights is made anew (core/reference.py: reweigh; core/normal.py: Moments).
#pragma once
#include <algorithm>
#include <numeric>

#include "template.h"

namespace ecc {

struct Moments {  // normal.Moments
  double count;
  Matrix normal, power;
  double gram[4][4], noise[2][4];
};
static_assert(sizeof(Moments) == 8 * ECC_MOMENTS);

inline const std::vector<int> SHAPE{4, MOST, MOST + 1, 3};  // 1, u, v and t among `columns` of R

struct Border {  // what is known of the pixels `of` a template that count
  const Pixels* of = nullptr;
  std::vector<float> seen, weight, before, z, r;  // (height, pitch): in sight; as they count; columns of Z and R
  Moments moments;
  Weighted weighted;
};

// criteria.safe_inverse by Gauss-Jordan, with rows and columns brought to unit diagonal; zero if singular to float32.
inline void invert(Matrix& matrix, int64_t n) {
  double scale[MOST], wide[MOST][2 * MOST] = {}, size = 0;
  bool regular = true;
  for (int64_t i = 0; i < n; ++i) {
    scale[i] = 1 / std::sqrt(std::max(std::abs(matrix[i][i]), 1e-30));
    regular = regular && matrix[i][i] > 0;
  }
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t j = 0; j < n; ++j) wide[i][j] = matrix[i][j] * scale[i] * scale[j];
    wide[i][n + i] = 1;
  }
  for (int64_t k = 0; k < n; ++k) {
    for (int64_t i = k + 1; i < n; ++i)
      if (std::abs(wide[i][k]) > std::abs(wide[k][k])) std::swap(wide[k], wide[i]);
    const double pivot = wide[k][k];
    for (double& value : wide[k]) value /= pivot;
    for (int64_t i = 0; i < n; ++i)
      for (int64_t j = 2 * n - 1; i != k && j >= k; --j) wide[i][j] -= wide[i][k] * wide[k][j];
  }
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) size += std::abs(wide[i][n + j]);
  regular = regular && size < 1e6;  // NaN and infinity compare as singular
  for (int64_t i = 0; i < MOST; ++i)
    for (int64_t j = 0; j < MOST; ++j) matrix[i][j] = regular && i < n && j < n ? wide[i][n + j] * scale[i] * scale[j] : 0;
}

// The first `count` columns of Z (plane 0) or R (1), and then u and v: (MOST + 2, height, pitch).
inline void columns(const Pixels& p, int plane, int count, std::vector<float>& out) {
  const int64_t size = p.height * p.pitch;
  const float slope = float(p.n->unit[2 * plane]), unit = float(p.n->unit[2 * plane + 1]);
  const float shift = float(p.shift(plane)), level = float(p.n->level[plane]);
  out.resize((MOST + 2) * size);
  for (int64_t j = 0; j < p.height; ++j) {
    const int16_t* const image = p.plane(3 * plane) + j * p.pitch;
    const float y = float(p.n->top + double(j) * p.step), v = y / float(p.n->half[1]);
    Vector x = first_x(p);
    for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * float(p.step)) {
      const Vector gx = slope * wide(image + i), gy = slope * wide(image + size + i), t = unit * wide(image + 2 * size + i);
      const Vector u = x / float(p.n->half[0]), lit = t + level, one = Vector{} + 1;
      const Vector value[] = {gx,      gy,          gx * y - gy * x, t + shift,   one, lit * u,
                              lit * v, lit * u * u, lit * (v * v),   lit * u * v, u,   one * v};
      for (int k = 0; k < MOST + 2; k = k + 1 == count ? MOST : k + 1)
        store(value[k], out.data() + k * size + j * p.pitch + i);
    }
  }
}

// out[i][j] = sum over the pixels of w times the column a[i] of A and b[j] of B.
template <class Out>
void gram(const std::vector<float>& w, const std::vector<float>& A, const std::vector<int>& a, const std::vector<float>& B,
          const std::vector<int>& b, Out& out) {
  constexpr int64_t CHUNK = 1024, AT_ONCE = 4;  // pixels that stay in the nearest cache; sums that do not wait for another
  const int64_t size = int64_t(w.size()), columns = int64_t(b.size());
  std::memset(&out, 0, sizeof out);
  for (int64_t first = 0; first < size; first += CHUNK)
    for (size_t i = 0; i < a.size(); ++i) {
      float of_a[CHUNK];
      const int64_t n = std::min(CHUNK, size - first);  // both are whole vectors
      for (int64_t k = 0; k < n; ++k) of_a[k] = w[first + k] * A[a[i] * size + first + k];
      for (int64_t j = 0; j < columns; j += AT_ONCE) {
        const float* of_b[AT_ONCE];
        Wide sum[AT_ONCE] = {};
        for (int64_t l = 0; l < AT_ONCE; ++l) of_b[l] = B.data() + b[std::min(j + l, columns - 1)] * size + first;
        for (int64_t k = 0; k < n; k += WIDEST)
          for (int64_t l = 0; l < AT_ONCE; ++l) sum[l] += load<Wide>(of_a + k) * load<Wide>(of_b[l] + k);
        for (int64_t l = 0; l < std::min(AT_ONCE, columns - j); ++l)
          for (int lane = 0; lane < WIDEST; ++lane) out[i][j + l] += double(sum[l][lane]);
      }
    }
}

// Narrows first <= i <= last, whole numbers, to where from + i step is between 0 and end.
inline void clip(double from, double step, double end, double& first, double& last) {
  const double low = -ECC_ROUNDING - from, high = end + ECC_ROUNDING - from;
  if (step != 0) {
    first = std::max(first, std::ceil((step > 0 ? low : high) / step));
    last = std::min(last, std::floor((step > 0 ? high : low) / step));
  } else if (!(low <= 0 && high >= 0)) {
    last = -1;
  }
}

// Of the weights that are in force: what grey levels count from.
inline void means(Border& b) {
  gram(b.weight, b.r, SHAPE, b.r, SHAPE, b.moments.gram);
  const auto& g = b.moments.gram;
  b.weighted.total = g[0][0];
  b.weighted.along = g[0][3];
  b.weighted.contrast = std::sqrt(std::max(g[3][3] - g[0][3] * g[0][3] / g[0][0], 0.0));
}

// Weights of the pixels that the warp puts inside the frame, as their blocks are trusted, and what follows from them for
// the loop. False if none is.
inline bool weigh(const Template& t, const Pixels& p, const Warp& warp, const Frame& frame, Border& b) {
  b.before.swap(b.weight);
  b.weight.assign(p.height * p.pitch, 0);
  b.seen.assign(p.height * p.pitch, 0);
  float any = 0;
  for (int64_t j = 0; j < p.height; ++j) {
    const double u = p.n->left, v = p.n->top + double(j) * p.step;
    double first = 0, last = double(p.width - 1);  // a row's visible pixels, all of which lie side by side
    clip(warp.x(u, v), warp.xu * p.step, double(frame.w - 1), first, last);
    clip(warp.y(u, v), warp.yu * p.step, double(frame.h - 1), first, last);
    const float* const of = p.weights.at + j * p.weights.pitch;
    if (!(first <= last)) continue;
    for (int64_t i = int64_t(first); i <= int64_t(last); ++i) {
      b.seen[j * p.pitch + i] = of[i];
      any = std::max(any, b.weight[j * p.pitch + i] = of[i] * p.trusted(j, i));
    }
  }
  if (!(any > 0)) return false;
  if (b.of == &p && b.before == b.weight) return true;
  if (b.of != &p) {
    columns(p, 0, t.lines(), b.z);
    columns(p, 1, t.lines(), b.r);
  }
  b.of = &p;
  std::vector<int> all(t.lines());
  std::iota(all.begin(), all.end(), 0);
  gram(b.weight, b.z, all, b.r, all, b.moments.normal);
  const auto& m = b.moments.normal;
  Weighted& w = b.weighted;
  w = {0, 0, 0, {m[0][3], m[1][3], m[2][3]}, {m[0][4], m[1][4], m[2][4]}};
  if (t.criterion == PAPER) means(b);
  std::copy_n(&m[0][0], MOST * MOST, &w.inverse[0][0]);
  invert(w.inverse, t.columns);
  return true;
}

// And the other moments.
inline void complete(const Template& t, const Pixels& p, Border& b) {
  means(b);
  std::vector<float> q(b.weight), square(b.weight);
  const double u = p.n->half[0], v = p.n->half[1];
  for (int power = 0; power < 2; ++power) {  // of q, then of q^2
    for (size_t i = 0; i < q.size(); ++i) q[i] = power ? q[i] * q[i] : q[i] * (p.plane(WIENER)[i] * (1.f / ECC_LEVELS));
    double g[3][3], *const arms = b.moments.noise[power];
    gram(q, b.r, {4, MOST, MOST + 1}, b.r, {4, MOST, MOST + 1}, g);
    arms[0] = g[0][0], arms[1] = g[0][1] * u, arms[2] = g[0][2] * v, arms[3] = g[1][1] * u * u + g[2][2] * v * v;
  }
  b.moments.count = 0;
  for (float& w : square) {
    b.moments.count += w > 0;
    w *= w;
  }
  std::vector<int> all(t.columns);
  std::iota(all.begin(), all.end(), 0);
  gram(square, b.z, all, b.z, all, b.moments.power);
}

}  // namespace ecc
