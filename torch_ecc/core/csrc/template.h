// A template as the loop reads it (core/packed.py): whole rows of 16-bit pixels, from which all columns of its criterion
// are made, and the sums over them.
//
// With Z the instruments and R the columns of criteria.py, K = (Z W R^T)^-1 Z W. Z and R are made of three images each
// (d/dx, d/dy and t) and the pixels' coordinates, so that K g = inverse * (Z W g) takes 6 bytes per pixel where K takes 4
// per column.
#pragma once
#include <array>

#include "sample.h"

namespace ecc {

constexpr int MOST = ECC_MOST, SSD = -1, PAPER = -2;  // columns; criteria in place of a number of light columns
constexpr int64_t BLOCK = ECC_BLOCK, SUMS = 10;       // px; rows of solver.summed
using Coefficients = std::array<double, MOST>;        // of [G, t less its mean, 1, t u, t v, t u^2, t v^2, t u v]
using Matrix = double[MOST][MOST];

struct Weighted {  // what depends on the weights; t less its mean
  double total, along, contrast;  // sum of w, of w t, and the weighted norm of t off its weighted mean
  double of_t[3], of_one[3];      // Z W t, Z W 1
  Matrix inverse;                 // (Z W R^T)^-1
};

struct Numbers {  // packed._numbers
  double left, top, half[2], radius;   // px from the centre; half the bounding box
  double unit[4], level[2], mean[2];   // of Z's slopes and t, of R's slopes and t; where their t count from; its mean
  Weighted weighted;
};

enum Plane { Z_X, Z_Y, Z_T, R_X, R_Y, R_T, WIENER, PLANES };

struct Weights {  // of rows that lie `pitch` apart: 0 if one row serves for all
  const float* at;
  int64_t pitch;
};

struct Pixels {  // of one template, all of them or those of every step-th row and column
  const int16_t* planes;  // (PLANES, height, pitch)
  const Numbers* n;
  Weights weights;
  int64_t width, height, pitch;
  double step;

  const int16_t* plane(int k) const { return planes + k * height * pitch; }
  int64_t line() const { return pitch + LANES; }  // from one line of sums to the next: a block may reach beyond a row
  double shift(int k) const { return n->level[k] - n->mean[k]; }  // of what the 16 bits of Z's or R's t count from
};

struct Template {
  int64_t criterion, columns;
  bool coarser;  // whether `coarse` leaves out any pixels
  Pixels whole, coarse;

  int light() const { return criterion < 0 ? 0 : int(criterion); }
  int lines() const { return 5 + light(); }
};

// Coordinates of the first pixels of a row.
inline Vector row_of(const Pixels& p) {
  Vector x;
  for (int k = 0; k < LANES; ++k) x[k] = float(p.n->left + k * p.step);
  return x;
}

// v where it has weight; elsewhere it may be anything, NaN too: whole vectors reach beyond what has been sampled.
inline Vector counted(const Vector& v, const Vector& weight) { return weight > 0 ? v : Vector{}; }

// By way of whole vectors of 32 bits, which compilers would otherwise take apart.
inline Vector wide(const int16_t* from) {
  return __builtin_convertvector(__builtin_convertvector(load<Shorts>(from), Ints), Vector);
}

// Asks for a row of images from memory well ahead of its use: they are too many for the processor to guess.
inline void fetch(const Pixels& p, int64_t row, int planes) {
  if (row >= p.height) return;
  for (int k = 0; k < planes; ++k)
    for (int64_t at = row * p.pitch; at < (row + 1) * p.pitch; at += 32) __builtin_prefetch(p.plane(k) + at);
}

// The light columns of t from its sums t, t y, t y^2 less a level and those of 1, y, y^2, times what their place u, v is
// of x, y. x is the same down a column of pixels.
template <int light>
void lit(const Pixels& p, const Vector& x, float level, const Vector (&t)[3], const Vector (&one)[3], float* to) {
  const float u = float(1 / p.n->half[0]), v = float(1 / p.n->half[1]);
  const Vector by_x = (t[0] + level * one[0]) * (x * u), by_y = (t[1] + level * one[1]) * v;
  const Vector sum[] = {by_x, by_y, by_x * (x * u), (t[2] + level * one[2]) * (v * v), by_y * (x * u)};
  for (int k = 0; k < light; ++k) store(sum[k], to + k * p.line());
}

// lines (5 + light + squares, pitch) = sums down `rows` rows from `first` on of each column of Z, in 16-bit units, times
// w (g - base); and of w (g - base)^2. g: (rows, pitch). even: one row of weights serves for all.
template <int light, bool squares, bool even>
void products(const Pixels& p, const Weights& weights, int64_t first, int64_t rows, const float* g, float base,
              float* lines) {
  const int16_t *zx = p.plane(Z_X), *zy = p.plane(Z_Y), *zt = p.plane(Z_T);
  const float* weight = weights.at + first * weights.pitch;
  const float level = float(p.n->level[0] / p.n->unit[1]), step = float(p.step);
  const float top = float(p.n->top + double(first) * p.step);
  Vector x = row_of(p);
  for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * step) {
    Vector gx{}, gxy{}, gy{}, t[3]{}, one[3]{}, square{}, w = load<Vector>(weight + i);
    for (int64_t j = 0; j < rows; ++j) {
      const int64_t at = (first + j) * p.pitch + i;
      const float y = top + float(j) * step;
      if constexpr (!even) w = load<Vector>(weight + j * weights.pitch + i);
      const Vector r = counted(load<Vector>(g + j * p.pitch + i) - base, w), wr = w * r;
      const Vector dx = wide(zx + at) * wr, bright = wide(zt + at) * wr;
      if constexpr (squares) square += wr * r;
      gx += dx;
      gxy += dx * y;
      gy += wide(zy + at) * wr;
      t[0] += bright;
      one[0] += wr;
      if constexpr (light > 0) {
        t[1] += bright * y;
        one[1] += wr * y;
      }
      if constexpr (light > 2) {
        t[2] += bright * (y * y);
        one[2] += wr * (y * y);
      }
    }
    const Vector sum[] = {gx, gy, gxy - gy * x, t[0], one[0]};
    for (int k = 0; k < 5; ++k) store(sum[k], lines + k * p.line() + i);
    lit<light>(p, x, level, t, one, lines + 5 * p.line() + i);
    if constexpr (squares) store(square, lines + (5 + light) * p.line() + i);
  }
}

template <bool even>
void products(const Template& t, const Pixels& p, const Weights& w, int64_t first, int64_t rows, const float* g,
              float base, float* lines) {
  if (t.criterion == PAPER) return products<0, true, even>(p, w, first, rows, g, base, lines);
  if (t.light() == 0) return products<0, false, even>(p, w, first, rows, g, base, lines);
  if (t.light() == 2) return products<2, false, even>(p, w, first, rows, g, base, lines);
  products<5, false, even>(p, w, first, rows, g, base, lines);
}

// Adds to `sums` those of Z W (g - base) over `rows` rows, and to `square` that of the squares. lines: room for them.
inline void add_products(const Template& t, const Pixels& p, const Weights& w, int64_t first, int64_t rows,
                         const float* g, float base, float* lines, Coefficients& sums, double& square) {
  if (w.pitch)
    products<false>(t, p, w, first, rows, g, base, lines);
  else
    products<true>(t, p, w, first, rows, g, base, lines);
  const int count = t.lines();
  for (int k = 0; k < count + (t.criterion == PAPER); ++k, lines += p.line()) {
    Vector sum{};
    for (int64_t i = 0; i < p.pitch; i += LANES) sum += load<Vector>(lines + i);
    double total = 0;
    for (int l = 0; l < LANES; ++l) total += double(sum[l]);
    (k < count ? sums[k] : square) += total;
  }
}

// From sums of Z in 16-bit units to those of criteria.py's columns: t counts from its mean.
inline void rescale(const Template& t, const Pixels& p, Coefficients& sums) {
  const double* unit = p.n->unit;
  for (int k = 0; k < t.lines(); ++k) sums[k] *= k < 3 ? unit[0] : k == 4 ? 1 : unit[1];
  sums[3] += p.shift(0) * sums[4];
}

inline Coefficients multiply(const Template& t, const Matrix& inverse, const Coefficients& sums) {
  Coefficients u{};
  for (int64_t i = 0; i < t.columns; ++i)
    for (int64_t j = 0; j < t.columns; ++j) u[i] += inverse[i][j] * sums[j];
  return u;
}

// The column k of R (plane 1) or Z (0), (height, pitch).
inline void column(const Pixels& p, int plane, int k, float* out) {
  const int16_t* const image = p.plane(3 * plane);
  const int64_t size = p.height * p.pitch;
  const float slope = float(p.n->unit[2 * plane]), unit = float(p.n->unit[2 * plane + 1]), step = float(p.step);
  const float shift = float(p.shift(plane)), level = float(p.n->level[plane]), left = float(p.n->left);
  const float by_u = float(1 / p.n->half[0]), by_v = float(1 / p.n->half[1]);
  const auto fill = [&](auto value) {
    for (int64_t j = 0; j < p.height; ++j) {
      const int16_t* const row = image + j * p.pitch;
      const float y = float(p.n->top + double(j) * p.step);
      for (int64_t i = 0; i < p.pitch; ++i) out[j * p.pitch + i] = value(row + i, left + float(i) * step, y);
    }
  };
  const auto light = [&](auto of) {
    fill([&](const int16_t* at, float x, float y) { return (unit * at[2 * size] + level) * of(x * by_u, y * by_v); });
  };
  if (k == 0) fill([&](const int16_t* at, float, float) { return slope * at[0]; });
  if (k == 1) fill([&](const int16_t* at, float, float) { return slope * at[size]; });
  if (k == 2) fill([&](const int16_t* at, float x, float y) { return slope * (at[0] * y - at[size] * x); });
  if (k == 3) fill([&](const int16_t* at, float, float) { return unit * at[2 * size] + shift; });
  if (k == 4) fill([&](const int16_t*, float, float) { return 1.f; });
  if (k == 5) light([](float u, float) { return u; });
  if (k == 6) light([](float, float v) { return v; });
  if (k == 7) light([](float u, float) { return u * u; });
  if (k == 8) light([](float, float v) { return v * v; });
  if (k == 9) light([](float u, float v) { return u * v; });
}

}  // namespace ecc
