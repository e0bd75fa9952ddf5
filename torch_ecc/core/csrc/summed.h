// What is left of the last patch, summed in every block of its pixels: solver.summed.
#pragma once
#include "solve.h"

namespace ecc {

struct Offsets {  // that bring g - base and t (less its mean) to their weighted means
  float g, t;
};

// lines (5 + light, pitch) = sums down `rows` rows from `first` on of Z, in 16-bit units, times w e; behind them
// (6, pitch) of w {1, g0, g0^2, t0 g0, v g0} and of w e^2; e = g - base less the fit.
template <int light>
void residuals(const Pixels& p, const Weights& weights, int64_t first, int64_t rows, const float* g, const Model& m,
               const Offsets& off, float* lines) {
  const int16_t *zx = p.plane(Z_X), *zy = p.plane(Z_Y), *zt = p.plane(Z_T);
  const int16_t *rx = p.plane(R_X), *ry = p.plane(R_Y), *rt = p.plane(R_T);
  const float* weight = weights.at + first * weights.pitch;
  const double* unit = p.n->unit;
  const float z_level = float(p.n->level[0] / unit[1]), level = float(p.n->level[1]), step = float(p.step);
  const float top = float(p.n->top + double(first) * p.step), grey = float(unit[3]), shift = float(p.shift(1));
  const float by_u = float(1 / p.n->half[0]), by_v = float(1 / p.n->half[1]);
  float b[MOST];
  for (int k = 0; k < MOST; ++k) b[k] = float(m.fit[k] * (k < 3 ? unit[2] : 1));
  Vector x = row_of(p);
  for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * step) {
    Vector gx{}, gxy{}, gy{}, t[3]{}, one[3]{}, ww{}, wg{}, wgg{}, wtg{}, wgy{}, wee{}, w = load<Vector>(weight + i);
    const Vector u = x * by_u;
    for (int64_t j = 0; j < rows; ++j) {
      const int64_t at = (first + j) * p.pitch + i;
      const float y = top + float(j) * step, v = y * by_v;
      if (weights.pitch) w = load<Vector>(weight + j * weights.pitch + i);
      const Vector value = counted(load<Vector>(g + j * p.pitch + i) - m.base, w), bright = grey * wide(rt + at);
      const Vector rx_ = wide(rx + at), ry_ = wide(ry + at);
      Vector e = value - (b[0] + b[2] * y) * rx_ - (b[1] - b[2] * x) * ry_ - b[3] * (bright + shift) - b[4];
      if constexpr (light > 0) {
        Vector shade = b[5] * u + b[6] * v;
        if constexpr (light > 2) shade += b[7] * u * u + b[8] * (v * v) + b[9] * u * v;
        e -= shade * (bright + level);
      }
      e = counted(e, w);
      const Vector g0 = counted(value - off.g, w), t0 = bright + off.t, we = w * e, wg0 = w * g0;
      ww += w;
      wg += wg0;
      wgg += wg0 * g0;
      wtg += wg0 * t0;
      wgy += wg0 * v;
      wee += we * e;
      const Vector dx = wide(zx + at) * we, soft = wide(zt + at) * we;
      gx += dx;
      gxy += dx * y;
      gy += wide(zy + at) * we;
      t[0] += soft;
      one[0] += we;
      if constexpr (light > 0) {
        t[1] += soft * y;
        one[1] += we * y;
      }
      if constexpr (light > 2) {
        t[2] += soft * (y * y);
        one[2] += we * (y * y);
      }
    }
    const Vector sum[] = {gx, gy, gxy - gy * x, t[0], one[0]}, rest[] = {ww, wg, wgg, wtg, wg * u, wgy, wee};
    for (int k = 0; k < 5; ++k) store(sum[k], lines + k * p.line() + i);
    lit<light>(p, x, z_level, t, one, lines + 5 * p.line() + i);
    for (int k = 0; k < 7; ++k) store(rest[k], lines + (5 + light + k) * p.line() + i);
  }
}

// The rows of K in terms of Z's sums in 16-bit units.
inline void rows_of_K(const Template& t, const Pixels& p, const Weighted& w, float (&K)[3][MOST]) {
  for (int k = 0; k < 3; ++k)
    for (int c = 0; c < MOST; ++c) {
      const double unit = c < 3 ? p.n->unit[0] : c == 4 ? 1 : p.n->unit[1];
      K[k][c] = float(w.inverse[k][c] * unit + (c == 4 ? w.inverse[k][3] * p.shift(0) : 0));
    }
}

// to (SUMS, blocks), of a row of blocks `from` lines (5 + light + 7, pitch); room for three more lines behind them.
inline void blocks(const Template& t, const Pixels& p, const float (&K)[3][MOST], float* from, int64_t blocks, float* to) {
  const int count = t.lines();
  float* const influence = from + (count + 7) * p.line();
  for (int64_t i = 0; i < p.pitch; i += LANES)
    for (int k = 0; k < 3; ++k) {
      Vector sum{};
      for (int c = 0; c < count; ++c) sum += K[k][c] * load<Vector>(from + c * p.line() + i);
      store(sum, influence + k * p.line() + i);
    }
  const int64_t across = (p.width + BLOCK - 1) / BLOCK;
  for (int k = 0; k < SUMS; ++k) {
    const float* const line = from + (count + k) * p.line();
    for (int64_t b = 0; b < across; ++b) {
      float sum = 0;
      for (int64_t i = 0; i < BLOCK; ++i) sum += line[b * BLOCK + i];
      to[k * blocks + b] = sum;
    }
  }
}

// sums (SUMS, blocks) of the last patch and its fit.
inline void summed(const Template& t, Scratch& scratch, float* sums) {
  const Pixels& p = t.whole;
  const Weighted& w = scratch.weighted(p);
  const Weights weights = scratch.weights(p);
  const Model& m = scratch.model;
  const double mean = m.sums[4] / w.total;
  const Offsets off{float(mean), float(p.shift(1) - w.along / w.total)};
  const int64_t across = (p.width + BLOCK - 1) / BLOCK, count = across * ((p.height + BLOCK - 1) / BLOCK);
  float K[3][MOST];
  rows_of_K(t, p, w, K);
  double power = 0;
  for (int64_t first = 0; first < p.height; first += BLOCK) {
    const int64_t rows = std::min(BLOCK, p.height - first);
    const float* const band = scratch.patch.data() + first * p.pitch;
    const auto go = t.light() == 0 ? residuals<0> : t.light() == 2 ? residuals<2> : residuals<5>;
    for (int64_t j = 0; j < rows; ++j) fetch(p, first + BLOCK + j, 6);
    go(p, weights, first, rows, band, m, off, scratch.lines.data());
    float* const to = sums + first / BLOCK * across;
    blocks(t, p, K, scratch.lines.data(), count, to);
    for (int64_t b = 0; b < across; ++b) power += double(to[2 * count + b]);
  }
  const double level = mean + m.base;  // of a patch that is flat but for rounding nothing is left
  if (!(power > ECC_FLAT * (power + level * level * w.total))) std::fill_n(sums + count, 5 * count, 0.f);
}

}  // namespace ecc
