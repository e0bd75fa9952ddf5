// A template as the loop reads it: whole rows of 16-bit pixels, from which all columns of its criterion are made.
//
// With Z the instruments and R the columns of criteria.py, K = (Z W R^T)^-1 Z W. All columns are made of three images
// (d/dx, d/dy and t) and the pixels' coordinates, so that K g = inverse * (Z W g) takes 6 bytes per pixel where K takes
// 4 per column. `inverse` is made from the rounded Z: K R = 1 holds exactly, and rounding cannot shift a pose.
//
// What judge.h has to know of the rest of a patch, r = g - R^T u, needs no second pass over the pixels either: sums of
// g less a model known beforehand, and constants of the template (`gram`, `parts`), tell it.
#pragma once
#include <array>

#include "sample.h"

namespace ecc {

constexpr int MOST = 10, SSD = -1, PAPER = -2;  // columns; criteria in place of a number of light columns
constexpr int64_t BLOCK = 6;                    // reference.BLOCK
using Coefficients = std::array<double, MOST>;  // of [G, t - level, 1, t x', t y', t x'^2, t y'^2, t x' y']

struct Sums {
  Coefficients z{}, r{};  // Z W r and, of whole templates, R W r from the column t - level on
  double squares = 0;     // r W r
};

struct Pixels {  // of a template, all of them or those of every step-th row and column, as far as they are used
  int64_t width, height, pitch, weight, weight_pitch, columns;  // weight: of a row, in bytes from the template
  int64_t z[3], t;         // where d/dx, d/dy and t of Z and, if not 0, the raw t begin, likewise
  double left, top, step;  // relative to the centre, px
  double contrast;         // weighted norm of t less its mean
  float soft, soft_level, grey, level;  // unit of Z's t and of the raw t, and what they count from
  double inverse[MOST][MOST];
  Coefficients of_level, of_one;  // Z W (t - level) and Z W 1
};

struct Template {  // the head of a block of bytes; images and weights lie behind it
  int64_t criterion, columns, blocks, count, thinned;  // thinned: whether `thin` leaves out any pixels
  double box[2][4], centre[2], radius, noise, noise_share;
  double gram[MOST][MOST];  // R W R^T, at least as far as the column 1
  double white[3];          // square sums of K's first rows
  double alias[12], slope[9], spread[9], inflation[9], spread_noise[9];
  int64_t parts, parts_pitch;  // where the sums of K's first rows times R over each block begin, and their row
  float part[3][MOST];         // units of those: (rows of blocks, 3, columns, parts_pitch)
  float K[3][MOST];            // first rows of the inverse
  Pixels whole, thin;

  template <class T>
  const T* at(int64_t offset) const {
    return reinterpret_cast<const T*>(reinterpret_cast<const char*>(this) + offset);
  }
  int light() const { return criterion < 0 ? 0 : int(criterion); }
};

// Lines of sums that `products` makes: Z's columns, r W r, and of the columns of R that hold t.
inline int64_t lines_of(const Template& t) { return 7 + 2 * t.light(); }

inline int64_t rows_of_blocks(const Pixels& p) { return (p.height + BLOCK - 1) / BLOCK; }

// Coordinates of the first pixels of a row.
inline Vector row_of(const Pixels& p) {
  Vector x;
  for (int k = 0; k < LANES; ++k) x[k] = float(p.left + k * p.step);
  return x;
}

// v where it has weight; elsewhere it may be anything, NaN too: whole vectors reach beyond what has been sampled.
inline Vector counted(const Vector& v, const Vector& weight) { return weight > 0 ? v : Vector{}; }

// By way of whole vectors of 32 bits, which compilers would otherwise take apart.
inline Vector wide(const int16_t* from) {
  return __builtin_convertvector(__builtin_convertvector(load<Shorts>(from), Ints), Vector);
}

// Asks for a row of images from memory well ahead of its use: they are too many for the processor to guess.
inline void fetch(const Template& t, const Pixels& p, int64_t row) {
  if (row >= p.height) return;
  const int64_t begin = 2 * row * p.pitch, end = begin + 2 * p.pitch;
  for (int64_t offset : {p.z[0], p.z[1], p.z[2], p.t})
    for (int64_t at = begin; offset > 0 && at < end; at += 64) __builtin_prefetch(t.at<char>(offset + at));
}

// lines (lines_of, pitch) = sums over `rows` rows from `first` on of each column of Z times w r, of r w r and, if
// whole, of R's columns that hold t, in units of Z and R; r = v less a model by R from t on, or by the column 1 alone.
// x is the same down a column of pixels: it is left to the end. even: one row of weights serves for all. v: (rows, pitch)
template <int light, bool even, bool whole>
void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, const Coefficients& model,
              float* lines) {
  const int16_t *zx = t.at<int16_t>(p.z[0]), *zy = t.at<int16_t>(p.z[1]), *zt = t.at<int16_t>(p.z[2]);
  const int16_t* grey_of_r = t.at<int16_t>(p.t);
  const float* weight = t.at<float>(p.weight) + first * p.weight_pitch;
  const float soft_level = p.soft_level / p.soft, level = p.level / p.grey, step = float(p.step), top = float(p.top + double(first) * p.step);
  float by[MOST];
  for (int k = 3; k < MOST; ++k) by[k] = float(model[k]) * (k == 4 ? 1 : p.grey);
  Vector x = row_of(p);
  for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * step) {
    Vector gx{}, gxy{}, gy{}, grey{}, greyy{}, greyyy{}, all{}, ally{}, allyy{};
    Vector squares{}, raw{}, rawy{}, rawyy{};
    Vector w = load<Vector>(weight + i);
    const Vector slope = x * (by[5] + x * by[7]), bend = by[6] + x * by[9];
    for (int64_t j = 0; j < rows; ++j) {
      const int64_t at = (first + j) * p.pitch + i;
      const float y = top + float(j) * step;
      if constexpr (!even) w = load<Vector>(weight + j * p.weight_pitch + i);
      Vector r = load<Vector>(v + j * p.pitch + i) - by[4], shade;
      if constexpr (whole) {
        shade = wide(grey_of_r + at);
        r -= by[3] * shade;
        if constexpr (light > 0) r -= (slope + y * (light > 2 ? bend + y * by[8] : bend)) * (shade + level);
      }
      r = counted(r, w);
      const Vector wr = w * r, dx = wide(zx + at) * wr, bright = wide(zt + at) * wr;
      if constexpr (whole) {
        shade *= wr;
        raw += shade;
        if constexpr (light > 0) rawy += shade * y;
        if constexpr (light > 2) rawyy += shade * (y * y);
      }
      squares += wr * r;
      gx += dx;
      gxy += dx * y;
      gy += wide(zy + at) * wr;
      grey += bright;
      all += wr;
      if constexpr (light > 0) {
        greyy += bright * y;
        ally += wr * y;
      }
      if constexpr (light > 2) {
        greyyy += bright * (y * y);
        allyy += wr * (y * y);
      }
    }
    const auto lit = [&](const Vector& t, const Vector& ty, const Vector& tyy, float level, float* to) {  // t x', t y' ...
      const Vector by_y = ty + level * ally, by_x = (t + level * all) * x;
      const Vector sum[] = {by_x, by_y, by_x * x, tyy + level * allyy, by_y * x};
      for (int k = 0; k < light; ++k) store(sum[k], to + k * p.pitch + i);
    };
    const Vector sum[] = {gx, gy, gxy - gy * x, grey, all};
    for (int k = 0; k < 5; ++k) store(sum[k], lines + k * p.pitch + i);
    lit(grey, greyy, greyyy, soft_level, lines + 5 * p.pitch);
    store(squares, lines + (5 + light) * p.pitch + i);
    store(raw, lines + (6 + light) * p.pitch + i);
    lit(raw, rawy, rawyy, level, lines + (7 + light) * p.pitch);
  }
}

template <bool even, bool whole>
void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, const Coefficients& model,
              float* lines) {
  if (t.light() == 0) products<0, even, whole>(t, p, first, rows, v, model, lines);
  if (t.light() == 2) products<2, even, whole>(t, p, first, rows, v, model, lines);
  if (t.light() == 5) products<5, even, whole>(t, p, first, rows, v, model, lines);
}

template <bool whole>
void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, const Coefficients& model,
              float* lines) {
  if (p.weight_pitch)
    products<false, whole>(t, p, first, rows, v, model, lines);
  else
    products<true, whole>(t, p, first, rows, v, model, lines);
}

inline void add_lines(const Template& t, const Pixels& p, const float* lines, Sums& sums) {
  const int64_t columns = 5 + t.light();
  const auto add = [&](double& total) {
    float sum = 0;
    for (int64_t i = 0; i < p.pitch; ++i) sum += lines[i];
    total += sum;
    lines += p.pitch;
  };
  for (int64_t k = 0; k < columns; ++k) add(sums.z[k]);
  add(sums.squares);
  for (int64_t k = 3; k < columns; ++k)
    if (k != 4) add(sums.r[k]);
}

inline Coefficients multiply(const Pixels& p, const Coefficients& sums) {
  Coefficients u{};
  for (int64_t i = 0; i < p.columns; ++i)
    for (int64_t j = 0; j < p.columns; ++j) u[i] += p.inverse[i][j] * sums[j];
  return u;
}

// to[k] (blocks of a row) = sums over each block of lines (lines_of, pitch) under the rows k of K. line: room for
// (3, pitch + BLOCK), zero to begin with.
inline void blocks(const Template& t, const float* lines, float* line, float* const (&to)[3]) {
  const Pixels& p = t.whole;
  const int64_t each = p.pitch + BLOCK;
  for (int64_t i = 0; i < p.pitch; i += LANES) {
    Vector sum[3] = {};
    for (int64_t c = 0; c < p.columns; ++c)
      for (int k = 0; k < 3; ++k) sum[k] += t.K[k][c] * load<Vector>(lines + c * p.pitch + i);
    for (int k = 0; k < 3; ++k) store(sum[k], line + k * each + i);
  }
  for (int k = 0; k < 3; ++k, line += each)
    for (int64_t b = 0; b * BLOCK < p.width; ++b) {
      float sum = 0;
      for (int64_t l = 0; l < BLOCK; ++l) sum += line[b * BLOCK + l];
      to[k][b] = sum;
    }
}

}  // namespace ecc
