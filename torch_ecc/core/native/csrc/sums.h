// Sums over the pixels of a template: of its columns Z times a patch, and of what is left of the last one.
#pragma once
#include "template.h"

namespace ecc {

struct Model {  // of a patch g
  float base = 0, mean = 0, t = 0;  // what g is taken off, the rest's weighted mean, and what brings t to its own
  Coefficients sums{}, fit{};       // Z W (g - base) and what Criterion.fit makes of g - base, of criteria.py's columns
  double square = 0, step[3] = {0, 0, 0};  // (g - base) W (g - base); Criterion.step
};

// v where it has weight; elsewhere it may be anything, NaN too: whole vectors reach beyond what has been sampled.
inline Vector counted(const Vector& v, const Vector& weight) { return weight > 0 ? v : Vector{}; }

// Asks for a row of images from memory well ahead of its use: they are too many for the processor to guess.
inline void fetch(const Pixels& p, int64_t row, int planes) {
  if (row >= p.height) return;
  for (int k = 0; k < planes; ++k)
    for (int64_t at = row * p.pitch; at < (row + 1) * p.pitch; at += 32) __builtin_prefetch(p.plane(k) + at);
}

// lines (5 + light, ...) = sums down `rows` rows from `first` on of each column of Z, in 16-bit units, times w e; and
// behind them, (7, ...), of w {1, g0, g0^2, t0 g0, u g0, v g0} if it is the `last` look, and of w e^2. e = g - base,
// less the fit if it is the last; g0 and t0: g and t off their weighted means; g: (rows, pitch). x is the same down a
// column of pixels: it is left to the end.
template <int light, bool last>
void add_down(const Pixels& p, const Weights& weights, int64_t first, int64_t rows, const float* g, const Model& m,
              float* lines) {
  const int16_t *zx = p.plane(Z_X), *zy = p.plane(Z_Y), *zt = p.plane(Z_T);
  const int16_t *rx = p.plane(R_X), *ry = p.plane(R_Y), *rt = p.plane(R_T);
  const double* const unit = p.n->unit;
  const float z_level = float(p.n->level[0] / unit[1]), level = float(p.n->level[1]), shift = float(p.shift(1));
  const float step = float(p.step), top = float(p.n->top + double(first) * p.step), gray = float(unit[3]);
  const float by_u = float(1 / p.n->half[0]), by_v = float(1 / p.n->half[1]);
  float b[MOST];
  for (int k = 0; k < MOST; ++k) b[k] = float(m.fit[k] * (k < 3 ? unit[2] : 1));
  Vector x = first_x(p);
  for (int64_t i = 0; i < p.pitch; i += LANES, x += LANES * step) {
    Vector gx{}, gxy{}, gy{}, t[3]{}, one[3]{}, rest[7]{};
    const Vector u = x * by_u;
    for (int64_t j = 0; j < rows; ++j) {
      const int64_t at = (first + j) * p.pitch + i;
      const float y = top + float(j) * step, v = y * by_v;
      const Vector w = load<Vector>(weights.at + (first + j) * weights.pitch + i);
      const Vector value = counted(load<Vector>(g + j * p.pitch + i) - m.base, w);
      Vector e = value;
      if constexpr (last) {
        const Vector bright = gray * wide(rt + at);
        Vector fit = (b[0] + b[2] * y) * wide(rx + at) + (b[1] - b[2] * x) * wide(ry + at) + b[3] * (bright + shift) + b[4];
        if constexpr (light > 0) {
          Vector shade = b[5] * u + b[6] * v;
          if constexpr (light > 2) shade += b[7] * u * u + b[8] * (v * v) + b[9] * u * v;
          fit += shade * (bright + level);
        }
        e = counted(value - fit, w);
        const Vector g0 = counted(value - m.mean, w), wg = w * g0;
        rest[0] += w;
        rest[1] += wg;
        rest[2] += wg * g0;
        rest[3] += wg * (bright + m.t);
        rest[5] += wg * v;
      }
      const Vector we = w * e, dx = wide(zx + at) * we, soft = wide(zt + at) * we;
      rest[6] += we * e;
      gx += dx;
      gxy += dx * y;
      gy += wide(zy + at) * we;
      t[0] += soft;
      one[0] += we;
      if constexpr (light > 0) {
        t[1] += soft * v;
        one[1] += we * v;
      }
      if constexpr (light > 2) {
        t[2] += soft * (v * v);
        one[2] += we * (v * v);
      }
    }
    rest[4] = rest[1] * u;
    const Vector lit = (t[0] + z_level * one[0]) * u, lit_v = t[1] + z_level * one[1], lit_vv = t[2] + z_level * one[2];
    const Vector sum[] = {gx, gy, gxy - gy * x, t[0], one[0], lit, lit_v, lit * u, lit_vv, lit_v * u};
    for (int k = 0; k < 5 + light; ++k) store(sum[k], lines + k * p.line() + i);
    for (int k = last ? 0 : 6; k < 7; ++k) store(rest[k], lines + (5 + light + k) * p.line() + i);
  }
}

template <bool last>
void add_down(const Template& t, const Pixels& p, const Weights& w, int64_t first, int64_t rows, const float* g,
              const Model& m, float* lines) {
  const auto go = t.light() == 0 ? add_down<0, last> : t.light() == 2 ? add_down<2, last> : add_down<5, last>;
  go(p, w, first, rows, g, m, lines);
}

// Adds to the model's sums those over `rows` rows, in 16-bit units. lines: room for them.
inline void add_up(const Template& t, const Pixels& p, const Weights& w, int64_t first, int64_t rows, const float* g,
                   Model& m, float* lines) {
  add_down<false>(t, p, w, first, rows, g, m, lines);
  const auto add = [&](int line, double& total) {
    Wide sum{};
    for (int64_t i = 0; i < p.pitch; i += WIDEST) sum += load<Wide>(lines + line * p.line() + i);
    for (int l = 0; l < WIDEST; ++l) total += double(sum[l]);
  };
  for (int k = 0; k < t.lines(); ++k) add(k, m.sums[k]);
  add(t.lines() + 6, m.square);
}

// What takes sums of Z in 16-bit units to those of criteria.py's column k: factor, and share of the sum of 1 to be added.
inline std::array<double, 2> rescaled(const Pixels& p, int k) {
  return {k < 3 ? p.n->unit[0] : k == 4 ? 1 : p.n->unit[1], k == 3 ? p.shift(0) : 0};
}

inline double finite(double value) { return std::isfinite(value) ? value : 0; }

// Sum of n values, in some lanes at once: of one order too.
template <class Value>
double added_up(int64_t n, Value value) {
  constexpr int64_t AT_ONCE = 8;
  double sum[AT_ONCE] = {}, total = 0;
  int64_t i = 0;
  for (; i + AT_ONCE <= n; i += AT_ONCE)
    for (int64_t l = 0; l < AT_ONCE; ++l) sum[l] += value(i + l);
  for (; i < n; ++i) total += value(i);
  for (double part : sum) total += part;
  return total;
}

// Square sum over lines of n values, from one to the next of which it is `step`, and `next` from line to line.
inline double squares(const float* from, int64_t lines, int64_t next, int64_t n, int64_t step) {
  return added_up(lines, [&](int64_t k) {
    double sum = 0;
    for (int64_t i = 0; i < n; ++i) sum += double(from[k * next + i * step]);
    return sum * sum;
  });
}

// sums (SUMS, blocks) of the last patch and its fit, as of solution.summed, and their total (SUMS + CLUSTERS).
// seen: the weights without trust.
inline void summed(const Template& t, const Pixels& p, const Weights& seen, const Weighted& w, const float* patch,
                   Model& m, float* lines, float* sums, double* total) {
  const int64_t across = blocks(p.width), count = across * blocks(p.height);
  const int n = t.lines();
  m.mean = float(m.sums[4] / w.total);
  m.t = float(p.shift(1) - w.along / w.total);
  float K[3][MOST];
  for (int k = 0; k < 3; ++k)
    for (int c = 0; c < MOST; ++c)
      K[k][c] = float(w.inverse[k][c] * rescaled(p, c)[0] + (c == 4 ? w.inverse[k][3] * rescaled(p, 3)[1] : 0));
  for (int64_t first = 0; first < p.height; first += BLOCK, sums += across) {
    const int64_t rows = std::min(BLOCK, p.height - first);
    for (int64_t j = 0; j < rows; ++j) fetch(p, first + BLOCK + j, 6);
    add_down<true>(t, p, seen, first, rows, patch + first * p.pitch, m, lines);
    for (int64_t i = 0; i < p.pitch; i += LANES)
      for (int k = 0; k < 3; ++k) {  // K e
        Vector sum{};
        for (int c = 0; c < n; ++c) sum += K[k][c] * load<Vector>(lines + c * p.line() + i);
        store(sum, lines + (n + 7 + k) * p.line() + i);
      }
    for (int k = 0; k < SUMS; ++k)
      for (int64_t b = 0; b < across; ++b) {
        const float* const line = lines + (n + k) * p.line() + b * BLOCK;
        float sum = 0;
        for (int64_t i = 0; i < BLOCK; ++i) sum += line[i];
        sums[k * count + b] = k >= SUMS - 3 && p.trust ? sum * p.trust[first / BLOCK * across + b] : sum;  // K is less
      }
  }
  sums -= count;
  const auto added = [&](int k) {
    const float* const row = sums + k * count;
    const float* const trust = k < SUMS - 3 ? p.trust : nullptr;
    return trust ? added_up(count, [&](int64_t i) { return double(row[i] * trust[i]); })
                 : added_up(count, [&](int64_t i) { return double(row[i]); });
  };
  const double level = m.mean + m.base, power = added(2);
  if (!(power > ECC_FLAT * (power + level * level * w.total)))  // of a patch that is flat but for rounding g0 is 0
    std::fill_n(sums + count, 5 * count, 0.f);
  for (int k = 0; k < SUMS; ++k) total[k] = finite(added(k));
  for (int k = 0; k < 3; ++k) {  // solution.clustered
    const float* const effect = sums + (SUMS - 3 + k) * count;
    total[SUMS + k] = finite(squares(effect, count, 1, 1, 1));
    total[SUMS + 3 + k] = finite(squares(effect, count / across, across, across, 1));
    total[SUMS + 6 + k] = finite(squares(effect, across, 1, count / across, across));
  }
}

}  // namespace ecc
