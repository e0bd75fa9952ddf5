// Values of a window between its pixels, row by row of a template: bilinear (degree 1) and B-spline (3, 5).
#pragma once
#include "window.h"

namespace ecc {

struct Warp {  // of a template's pixel (u, v) to the frame, x = xu u + xv v + x0 and y = yu u + yv v + y0
  double xu, xv, yu, yv, x0, y0;

  double x(double u, double v) const { return xu * u + xv * v + x0; }
  double y(double u, double v) const { return yv * v + yu * u + y0; }
};

struct Line {  // n points x + k dx, y + k dy; (0, 0) is where the first tap of a point is the window's first value
  float x, y, dx, dy;
  int n;
};

constexpr float UNIT[] = {0, 1, 0, 6, 0, 120};  // of the weights of each degree

// UNIT times the weights of the degree + 1 B-spline taps around a point with the fractional part t; of one, or of a vector.
template <int degree, class Real>
void weigh(Real t, Real (&w)[degree + 1]) {
  const Real r = 1 - t;
  if constexpr (degree == 1) {
    w[0] = r;
    w[1] = t;
  } else if constexpr (degree == 3) {
    const Real t2 = t * t;
    w[0] = r * r * r;
    w[3] = t2 * t;
    w[1] = t2 * (3.f * t - 6.f) + 4.f;
    w[2] = 6.f - w[1] - (w[0] + w[3]);
  } else {
    const Real t2 = t * t, r2 = r * r;
    w[0] = r2 * r2 * r;
    w[5] = t2 * t2 * t;
    // The quintic at 1 + t, 2 - t and at t, 1 - t, in powers of the distance to the nearer knot.
    w[1] = 1.f + r * (5.f + r * (10.f + r * (10.f + r * (5.f - 5.f * r))));
    w[4] = 1.f + t * (5.f + t * (10.f + t * (10.f + t * (5.f - 5.f * t))));
    w[2] = 66.f + t2 * (t2 * (30.f - t * 10.f) - 60.f);
    w[3] = 66.f + r2 * (r2 * (30.f - r * 10.f) - 60.f);
  }
}

// Neighbours on a line that turns little have neighbouring taps: up to where the line crosses into the next row or
// column, every tap of theirs is one vector as it stands in memory. body(at, i, left, fx, fy, lane) for each vector of
// points from the i-th on, of which `left` are left in their run: `at` the place of the first tap of the first of them,
// (fx, fy) how far they lie behind it, `lane` their numbers.
template <int degree, class Body>
void runs(const Window& window, const Line& line, Body body) {
  constexpr float BEYOND = 2e-5f;  // px that a run may go beyond: a line along a column of pixels would have no run
  const int64_t right = window.w - degree - 1, bottom = window.h - degree - 1;
  const float drift = line.dx - 1;
  const float per_column = 1 / std::max(std::abs(drift), 1e-9f), per_row = 1 / std::max(std::abs(line.dy), 1e-9f);
  Vector lane;
  for (int k = 0; k < LANES; ++k) lane[k] = float(k);
  for (int first = 0, last; first < line.n; first = last) {
    const float x = line.x + float(first) * line.dx, y = line.y + float(first) * line.dy;
    const int64_t ix = std::clamp<int64_t>(int64_t(x), 0, right), iy = std::clamp<int64_t>(int64_t(y), 0, bottom);
    const float fx = x - float(ix), fy = y - float(iy);
    const float room = std::min(((drift > 0 ? 1 - fx : fx) + BEYOND) * per_column,
                                ((line.dy < 0 ? fy : 1 - fy) + BEYOND) * per_row);
    last = first + 1 + int(std::clamp(room, 0.f, float(line.n)));
    last = std::min(last, line.n);
    for (int i = first; i < last; i += LANES) {
      const Vector along = lane + float(i - first);
      body(iy * window.pitch() + ix + i - first, i, last - i, fx + drift * along, fy + line.dy * along, lane + float(i));
    }
  }
}

// Writes whole vectors, from where the next run or nothing of worth follows.
template <int degree>
void sample_runs(const Window& window, const Line& line, float* out) {
  constexpr int taps = degree + 1;
  constexpr float unit = 1 / (UNIT[degree] * UNIT[degree]);
  const int64_t pitch = window.pitch();
  const float* const values = window.values.data();
  runs<degree>(window, line, [&](int64_t at, int i, int, const Vector& fx, const Vector& fy, const Vector&) {
    Vector wx[taps], wy[taps], sum{};
    weigh<degree, Vector>(fx, wx);
    weigh<degree, Vector>(fy, wy);
    for (int k = 0; k < taps; ++k) {
      Vector row = wx[0] * load<Vector>(values + at + k * pitch);
      for (int l = 1; l < taps; ++l) row += wx[l] * load<Vector>(values + at + k * pitch + l);
      sum += wy[k] * row;
    }
    store(sum * unit, out + i);
  });
}

// Any line, point by point.
template <int degree>
void sample_points(const Window& window, const Line& line, float* __restrict out) {
  constexpr int taps = degree + 1, CHUNK = 64, size = degree == 3 ? 4 : 8;  // of a vector that holds a row's taps
  typedef float Taps __attribute__((vector_size(4 * size)));
  constexpr float BELOW_ONE = 0.99999f, unit = 1 / (UNIT[degree] * UNIT[degree]);
  const float right = float(window.w - taps) + BELOW_ONE, bottom = float(window.h - taps) + BELOW_ONE;
  const int32_t pitch = int32_t(window.pitch());
  const float* const from = window.values.data();
  alignas(64) float fx[CHUNK], fy[CHUNK], row[CHUNK * size], below[CHUNK * 2], wx[taps][CHUNK], wy[taps][CHUNK];
  int32_t place[CHUNK];
  for (int first = 0; first < line.n; first += CHUNK, out += CHUNK) {
    const int n = std::min(line.n - first, CHUNK);
    for (int i = 0; i < CHUNK; ++i) {
      const float x = std::clamp(line.x + float(first + i) * line.dx, 0.f, right);
      const float y = std::clamp(line.y + float(first + i) * line.dy, 0.f, bottom);
      const int32_t ix = int32_t(x), iy = int32_t(y);
      fx[i] = x - float(ix);
      fy[i] = y - float(iy);
      place[i] = iy * pitch + ix;
    }
    if constexpr (degree == 1) {
      for (int i = 0; i < n; ++i) {
        std::memcpy(row + 2 * i, from + place[i], 8);
        std::memcpy(below + 2 * i, from + place[i] + pitch, 8);
      }
      for (int i = 0; i < n; ++i) {
        const float a = row[2 * i] + fx[i] * (row[2 * i + 1] - row[2 * i]);
        const float b = below[2 * i] + fx[i] * (below[2 * i + 1] - below[2 * i]);
        out[i] = a + fy[i] * (b - a);
      }
      continue;
    }
    for (int i = 0; i < CHUNK; i += LANES) {
      Vector x[taps], y[taps];
      weigh<degree, Vector>(load<Vector>(fx + i), x);
      weigh<degree, Vector>(load<Vector>(fy + i), y);
      for (int k = 0; k < taps; ++k) {
        store(x[k], wx[k] + i);
        store(y[k], wy[k] + i);
      }
    }
    for (int i = 0; i < n; ++i) {  // down the columns first, for all taps of a row at once
      Taps sum{}, next;
      for (int k = 0; k < taps; ++k) {
        std::memcpy(&next, from + place[i] + k * pitch, sizeof next);
        sum += next * wy[k][i];
      }
      std::memcpy(row + i * size, &sum, sizeof sum);
    }
    for (int i = 0; i < n; ++i) {
      float sum = 0;
      for (int k = 0; k < taps; ++k) sum += wx[k][i] * row[i * size + k];
      out[i] = sum * unit;
    }
  }
}

inline bool straight(const Line& line) {
  constexpr float STRAIGHT = 0.15f;  // rows crossed per px up to which runs are long enough to pay
  return line.dx > 0.9f && line.dx <= 1 && std::abs(line.dy) < STRAIGHT;
}

template <int degree>
void sample(const Window& window, const Line& line, float* out) {
  if (straight(line))
    sample_runs<degree>(window, line, out);
  else
    sample_points<degree>(window, line, out);
}

}  // namespace ecc
