// A template as the loop reads it (packed.py): whole rows of 16-bit pixels, from which all columns of its criterion
// are made.
//
// With Z the instruments and R the columns of criteria.py, K = (Z W R^T)^-1 Z W. Z and R are made of three images each
// (d/dx, d/dy and t) and the pixels' coordinates, so that K g = inverse * (Z W g) takes 6 bytes per pixel where K takes 4
// per column.
#pragma once
#include <array>

#include "sample.h"

namespace ecc {

constexpr int MOST = ECC_MOST, SSD = -1, PAPER = -2;  // columns; criteria in place of a number of light columns
constexpr int64_t BLOCK = ECC_BLOCK, SUMS = ECC_SUMS, CLUSTERS = ECC_CLUSTERS;  // px; see core/solution.py
inline int64_t blocks(int64_t n) { return (n + BLOCK - 1) / BLOCK; }  // along n px
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
static_assert(sizeof(Numbers) == 8 * ECC_NUMBERS && PLANES == ECC_PLANES);

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
  const float* trust;  // solution.Trust, of blocks of the whole template, `across` of them side by side; null if whole
  int64_t across;

  float trusted(int64_t row, int64_t column) const {
    return trust ? trust[row * int64_t(step) / BLOCK * across + column * int64_t(step) / BLOCK] : 1;
  }

  const int16_t* plane(int k) const { return planes + k * height * pitch; }
  int64_t line() const { return pitch + LANES; }  // from one line of sums to the next: a block may reach beyond a row
  double shift(int k) const { return n->level[k] - n->mean[k]; }  // of what the 16 bits of Z's or R's t count from
};

struct Template {
  int64_t criterion, columns;
  bool coarser;  // whether `coarse` is another grid
  Pixels whole, coarse;

  int light() const { return criterion < 0 ? 0 : int(criterion); }
  int lines() const { return 5 + light(); }
};

// By way of whole vectors of 32 bits, which compilers would otherwise take apart.
inline Vector wide(const int16_t* from) {
  return __builtin_convertvector(__builtin_convertvector(load<Shorts>(from), Ints), Vector);
}

// x' of the first pixels of a row.
inline Vector first_x(const Pixels& p) {
  Vector x;
  for (int k = 0; k < LANES; ++k) x[k] = float(p.n->left + k * p.step);
  return x;
}

}  // namespace ecc
