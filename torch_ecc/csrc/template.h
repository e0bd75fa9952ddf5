// A template as the loop reads it: whole rows of 16-bit pixels, from which all columns of its criterion are made.
//
// With Z the instruments and R the columns of criteria.py, K = (Z W R^T)^-1 Z W. All columns are made of three images
// (d/dx, d/dy and t) and the pixels' coordinates, so that K g = inverse * (Z W g) takes 6 bytes per pixel where K takes
// 4 per column. `inverse` is made from the rounded Z: K R = 1 holds exactly, and rounding cannot shift a pose.
#pragma once
#include <array>

#include "sample.h"

namespace ecc {

constexpr int MOST = 10, SSD = -1, PAPER = -2;  // columns; criteria in place of a number of light columns
constexpr int64_t BLOCK = 6;                    // reference.BLOCK
using Sums = std::array<double, MOST>;          // of Z W v: [G, t, 1, t x', t y', t x'^2, t y'^2, t x' y']

struct Images {  // d/dx and d/dy in units of `gradient`, t in units of `grey` counted from `level`
  int64_t at[3];  // where each begins, in bytes from the template
  float gradient, grey, level;
};

struct Pixels {  // of a template, all of them or those of every step-th row and column, as far as they are used
  int64_t width, height, pitch, weight, weight_pitch, columns;  // weight: of a row, in bytes from the template
  double left, top, step;  // relative to the centre, px
  double contrast;         // weighted norm of t less its mean
  Images z, r;
  double inverse[MOST][MOST];
  Sums of_level, of_one;  // Z W (t - level) and Z W 1
};

struct Template {  // the head of a block of bytes; images and weights lie behind it
  int64_t criterion, columns, blocks, count;
  double box[2][4], centre[2], radius, noise, noise_share;
  double w, wt, wtt;  // sums of the weights, times t - level, times its square
  double white[3];    // square sums of K's first rows
  double alias[12], slope[9], spread[9], inflation[9], spread_noise[9];
  Pixels whole, thin;

  template <class T>
  const T* at(int64_t offset) const {
    return reinterpret_cast<const T*>(reinterpret_cast<const char*>(this) + offset);
  }
  int light() const { return criterion < 0 ? 0 : int(criterion); }
};

// Coordinates of the first pixels of a row.
inline Vector row_of(const Pixels& p) {
  Vector x;
  for (int k = 0; k < LANES; ++k) x[k] = float(p.left + k * p.step);
  return x;
}

// v where it has weight; elsewhere it may be anything, NaN too: whole vectors reach beyond what has been sampled.
inline Vector counted(const float* v, const Vector& weight) { return weight > 0 ? load<Vector>(v) : Vector{}; }

// By way of whole vectors of 32 bits, which compilers would otherwise take apart.
inline Vector wide(const int16_t* from) {
  return __builtin_convertvector(__builtin_convertvector(load<Shorts>(from), Ints), Vector);
}

// Asks for a row of blocks from memory ahead of its use: too many rows at once for the processor to guess them.
inline void fetch(const Template& t, const Pixels& p, const Images& images, int64_t first) {
  const int64_t begin = 2 * first * p.pitch, end = 2 * std::min(first + BLOCK, p.height) * p.pitch;
  for (int64_t offset : images.at)
    for (int64_t at = begin; at < end; at += 64) __builtin_prefetch(t.at<char>(offset + at));
}

// lines (5 + light, pitch) = sums over `rows` rows from `first` on of each column of Z times w v. v: (rows, pitch)
// x is the same down a column of pixels: it is left to the end. even: one row of weights serves for all.
template <int light, bool even>
void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, float* lines) {
  const int16_t *zx = t.at<int16_t>(p.z.at[0]), *zy = t.at<int16_t>(p.z.at[1]), *zt = t.at<int16_t>(p.z.at[2]);
  const float* weight = t.at<float>(p.weight) + first * p.weight_pitch;
  const float level = p.z.level / p.z.grey, step = float(p.step), top = float(p.top + double(first) * p.step);
  Vector x = row_of(p);
  for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * step) {
    Vector gx{}, gxy{}, gy{}, grey{}, greyy{}, greyyy{}, all{}, ally{}, allyy{}, w = load<Vector>(weight + i);
    for (int64_t j = 0; j < rows; ++j) {
      const int64_t at = (first + j) * p.pitch + i;
      const float y = top + float(j) * step;
      if constexpr (!even) w = load<Vector>(weight + j * p.weight_pitch + i);
      const Vector wv = w * counted(v + j * p.pitch + i, w), dx = wide(zx + at) * wv, bright = wide(zt + at) * wv;
      gx += dx;
      gxy += dx * y;
      gy += wide(zy + at) * wv;
      grey += bright;
      all += wv;
      if constexpr (light > 0) {
        greyy += bright * y;
        ally += wv * y;
      }
      if constexpr (light > 2) {
        greyyy += bright * (y * y);
        allyy += wv * (y * y);
      }
    }
    const Vector ty = greyy + level * ally, tx = (grey + level * all) * x;
    const Vector sum[] = {gx, gy, gxy - gy * x, grey, all, tx, ty, tx * x, greyyy + level * allyy, ty * x};
    for (int k = 0; k < 5 + light; ++k) store(sum[k], lines + k * p.pitch + i);
  }
}

template <bool even>
void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, float* lines) {
  if (t.light() == 0) products<0, even>(t, p, first, rows, v, lines);
  if (t.light() == 2) products<2, even>(t, p, first, rows, v, lines);
  if (t.light() == 5) products<5, even>(t, p, first, rows, v, lines);
}

inline void products(const Template& t, const Pixels& p, int64_t first, int64_t rows, const float* v, float* lines) {
  p.weight_pitch ? products<false>(t, p, first, rows, v, lines) : products<true>(t, p, first, rows, v, lines);
}

inline void add_lines(const Template& t, const Pixels& p, const float* lines, Sums& sums) {
  for (int k = 0; k < 5 + t.light(); ++k) {
    float sum = 0;
    for (int64_t i = 0; i < p.pitch; ++i) sum += lines[k * p.pitch + i];
    sums[k] += sum;
  }
}

inline Sums multiply(const Pixels& p, const Sums& sums) {
  Sums u{};
  for (int64_t i = 0; i < p.columns; ++i)
    for (int64_t j = 0; j < p.columns; ++j) u[i] += p.inverse[i][j] * sums[j];
  return u;
}

// r = g less its model R^T u in `rows` rows from `first` on, with t less its level in column 3.
inline void residual(const Template& t, int64_t first, int64_t rows, const Sums& u, const float* v, float* r) {
  const Pixels& p = t.whole;
  const int16_t *rx = t.at<int16_t>(p.r.at[0]), *ry = t.at<int16_t>(p.r.at[1]), *rt = t.at<int16_t>(p.r.at[2]);
  const float unit = p.r.gradient, grey = p.r.grey, level = p.r.level, one = float(u[4]), turn = float(u[2]) * unit;
  for (int64_t j = 0; j < rows; ++j) {
    const double y = p.top + double(first + j);
    const float in_x = float(u[0] + u[2] * y) * unit, in_y = float(u[1]) * unit, gain = float(u[3]);
    const float even = float(u[6] * y + u[8] * y * y), slope = float(u[5] + u[9] * y), bend = float(u[7]);
    Vector x = row_of(p);
    for (int64_t i = 0; i < p.pitch; i += LANES, x += float(LANES)) {
      const int64_t at = (first + j) * p.pitch + i;
      const Vector contrast = wide(rt + at) * grey, light = even + x * (slope + x * bend);
      const Vector motion = in_x * wide(rx + at) + (in_y - turn * x) * wide(ry + at);
      store(load<Vector>(v + j * p.pitch + i) - one - motion - gain * contrast - light * (contrast + level),
            r + j * p.pitch + i);
    }
  }
}

}  // namespace ecc
