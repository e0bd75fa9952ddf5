// Values of a window between its pixels: bilinear (degree 1) and B-spline (3, 5), some hundred points at a time.
#pragma once
#include <cstring>

#include "window.h"

namespace ecc {

constexpr int CHUNK = 256;

struct Warp {  // template pixel (x', y') to the frame: x = c x' + s y' + x0, y = -s x' + c y' + y0 (eq. 2)
  double c, s, x0, y0;
};

// Weights of the degree + 1 B-spline taps around points with fractional parts f.
template <int degree>
void weigh(const float* f, int n, float (&w)[degree + 1][CHUNK]) {
  for (int i = 0; i < n; ++i) {
    const float t = f[i], r = 1 - t;
    if constexpr (degree == 3) {
      w[0][i] = r * r * r * (1.f / 6);
      w[3][i] = t * t * t * (1.f / 6);
      w[1][i] = 2.f / 3 + t * t * (0.5f * t - 1);
      w[2][i] = 2.f / 3 + r * r * (0.5f * r - 1);
    } else {
      const float t2 = t * t, r2 = r * r;
      w[0][i] = r2 * r2 * r * (1.f / 120);
      w[5][i] = t2 * t2 * t * (1.f / 120);
      // The quintic at 1 + t, 2 - t and at t, 1 - t, in powers of the distance to the nearer knot.
      w[1][i] = (1 + r * (5 + r * (10 + r * (10 + r * (5 - 5 * r))))) * (1.f / 120);
      w[4][i] = (1 + t * (5 + t * (10 + t * (10 + t * (5 - 5 * t))))) * (1.f / 120);
      w[2][i] = 11.f / 20 + t2 * (-0.5f + t2 * (0.25f - t * (1.f / 12)));
      w[3][i] = 11.f / 20 + r2 * (-0.5f + r2 * (0.25f - r * (1.f / 12)));
    }
  }
}

// Positions of n points in a window, rounded down, and what is left of them: held to where all taps exist.
template <int degree>
void locate(const Window& window, const Warp& warp, const float* __restrict px, const float* __restrict py, int n,
            float* __restrict fx, float* __restrict fy, int32_t* __restrict place) {
  constexpr float BELOW_ONE = 0.99999f;
  const float c = float(warp.c), s = float(warp.s), x0 = float(warp.x0 - double(window.x0 + degree / 2)),
              y0 = float(warp.y0 - double(window.y0 + degree / 2));
  const float right = float(window.w - degree - 1) + BELOW_ONE, bottom = float(window.h - degree - 1) + BELOW_ONE;
  const int32_t pitch = int32_t(window.pitch());
  for (int i = 0; i < n; ++i) {
    const float x = std::clamp(c * px[i] + s * py[i] + x0, 0.f, right);
    const float y = std::clamp(c * py[i] - s * px[i] + y0, 0.f, bottom);
    const int32_t ix = int32_t(x), iy = int32_t(y);
    fx[i] = x - float(ix);
    fy[i] = y - float(iy);
    place[i] = iy * pitch + ix;
  }
}

// g[i] = value at the warped (px[i], py[i]), i < n <= CHUNK.
template <int degree>
void sample(const Window& window, const Warp& warp, const float* px, const float* py, int n, float* __restrict g) {
  constexpr int taps = degree + 1, size = degree == 3 ? 4 : 8;  // of a vector that holds the taps of a row
  typedef float Vector __attribute__((vector_size(4 * size)));
  float fx[CHUNK], fy[CHUNK];
  int32_t place[CHUNK];
  locate<degree>(window, warp, px, py, n, fx, fy, place);
  const int32_t pitch = int32_t(window.pitch());
  const float* const from = window.values.data();
  if constexpr (degree == 1) {
    alignas(64) float above[2 * CHUNK], below[2 * CHUNK];
    for (int i = 0; i < n; ++i) {
      std::memcpy(above + 2 * i, from + place[i], 8);
      std::memcpy(below + 2 * i, from + place[i] + pitch, 8);
    }
    for (int i = 0; i < n; ++i) {
      const float a = above[2 * i] + fx[i] * (above[2 * i + 1] - above[2 * i]);
      const float b = below[2 * i] + fx[i] * (below[2 * i + 1] - below[2 * i]);
      g[i] = a + fy[i] * (b - a);
    }
  } else {
    float wx[taps][CHUNK], wy[taps][CHUNK];
    alignas(64) float row[CHUNK * size];
    weigh<degree>(fx, n, wx);
    weigh<degree>(fy, n, wy);
    for (int i = 0; i < n; ++i) {  // down the columns first, for all taps of a row at once
      Vector sum{}, next;
      for (int k = 0; k < taps; ++k) {
        std::memcpy(&next, from + place[i] + k * pitch, sizeof next);
        sum += next * wy[k][i];
      }
      std::memcpy(row + i * size, &sum, sizeof sum);
    }
    for (int i = 0; i < n; ++i) {
      float sum = 0;
      for (int k = 0; k < taps; ++k) sum += wx[k][i] * row[i * size + k];
      g[i] = sum;
    }
  }
}

}  // namespace ecc
