// The neighbourhood of a patch as float32: read from the frame in its own dtype, prefiltered if a spline is asked for.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace ecc {

#ifdef __AVX512F__
constexpr int LANES = 16;
#else
constexpr int LANES = 8;
#endif
typedef float Vector __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef int16_t Shorts __attribute__((vector_size(2 * LANES)));

template <class V, class T>
V load(const T* from) {
  V values;
  std::memcpy(&values, from, sizeof values);
  return values;
}

inline void store(const Vector& values, float* to) { std::memcpy(to, &values, sizeof values); }

inline int64_t padded(int64_t n) { return (n + LANES - 1) / LANES * LANES; }

struct Frame {  // rows of one grey frame where they are, in any of the three dtypes
  const void* data;
  int64_t h, w, stride;
  enum { U8, U16, F32 } dtype;
};

struct Window {  // values at frame positions (x0 .. x0 + w - 1, y0 .. y0 + h - 1)
  static constexpr int64_t SPARE = 2 * LANES;  // a row is read in whole vectors, at most so far beyond its end
  int64_t x0 = 0, y0 = 0, w = 0, h = 0;
  std::vector<float> values, raw, line;
  int64_t pitch() const { return w + SPARE; }
};

// Where a position beyond the border has its value from: the border repeats, or the frame is mirrored there.
inline int64_t within(int64_t i, int64_t n, bool mirrored) {
  if (mirrored && n > 1) {
    i = std::abs(i) % (2 * n - 2);
    i = std::min(i, 2 * n - 2 - i);
  }
  return std::clamp<int64_t>(i, 0, n - 1);
}

template <class Pixel>
void read_rows(const Frame& frame, int64_t x0, int64_t y0, int64_t w, int64_t h, int64_t pitch, bool mirrored,
               float* out) {
  constexpr int64_t LINE = 64 / sizeof(Pixel), AHEAD = 16;  // a frame is new: its rows are fetched ahead of their use
  const int64_t first = std::clamp<int64_t>(-x0, 0, w), last = std::clamp<int64_t>(frame.w - x0, first, w);
  const auto at = [&](int64_t j) {
    return static_cast<const Pixel*>(frame.data) + within(y0 + j, frame.h, mirrored) * frame.stride;
  };
  for (int64_t j = 0; j < h; ++j, out += pitch) {
    const Pixel* const row = at(j);
    for (int64_t i = first; i < last + LINE; i += LINE) __builtin_prefetch(at(j + AHEAD) + x0 + std::min(i, last - 1));
    for (int64_t i = 0; i < first; ++i) out[i] = float(row[within(x0 + i, frame.w, mirrored)]);
    for (int64_t i = first; i < last; ++i) out[i] = float(row[x0 + i]);
    for (int64_t i = last; i < w; ++i) out[i] = float(row[within(x0 + i, frame.w, mirrored)]);
  }
}

inline void read(const Frame& frame, int64_t x0, int64_t y0, int64_t w, int64_t h, int64_t pitch, bool mirrored,
                 float* out) {
  if (frame.dtype == Frame::U8) read_rows<uint8_t>(frame, x0, y0, w, h, pitch, mirrored, out);
  if (frame.dtype == Frame::U16) read_rows<uint16_t>(frame, x0, y0, w, h, pitch, mirrored, out);
  if (frame.dtype == Frame::F32) read_rows<float>(frame, x0, y0, w, h, pitch, mirrored, out);
}

// Samples to coefficients of the interpolating B-spline, one pole z of the inverse filter after the other (Unser et
// al., 1993, I). `start` px from a border it is forgotten.
template <int degree>
struct Prefilter {
  static constexpr int poles = degree / 2, start = degree == 3 ? 15 : 18;

  static double pole(int p) {
    const double inner = std::sqrt(17745.0 / 4), outer = std::sqrt(105.0 / 4);
    if (degree == 3) return std::sqrt(3.0) - 2;
    return p == 0 ? std::sqrt(67.5 - inner) + outer - 6.5 : std::sqrt(67.5 + inner) - outer - 6.5;
  }

  // Down the columns, recursively from both ends, started as if the border went on; `pitch` a multiple of 4 LANES.
  static void columns(float* values, int64_t h, int64_t pitch) {
    constexpr int SIDE = 4;  // vectors side by side: one alone would wait for itself
    for (int p = 0; p < poles; ++p) {
      const float z = float(pole(p)), rest = 1 - z, gain = rest * rest;
      for (int64_t i = 0; i < pitch; i += SIDE * LANES) {
        Vector last[SIDE];
        const auto go = [&](int64_t j, float now, float before) {
          for (int k = 0; k < SIDE; ++k) {
            float* const at = values + j * pitch + i + k * LANES;
            last[k] = now * load<Vector>(at) + before * last[k];
            store(last[k], at);
          }
        };
        for (int k = 0; k < SIDE; ++k) last[k] = load<Vector>(values + i + k * LANES) * rest;
        for (int64_t j = 0; j < h; ++j) go(j, gain, z);
        for (int k = 0; k < SIDE; ++k) last[k] = load<Vector>(values + (h - 1) * pitch + i + k * LANES) / rest;
        for (int64_t j = h - 1; j >= 0; --j) go(j, 1, z);
      }
    }
  }

  // Along a row of w + 2 start values, which it overwrites: 1 / ((1 - z S) (1 - z / S)), S a shift by one px, is the
  // product over m = 1, 2, 4 ... of (1 + z^m S^m) (1 + z^m / S^m), so that each factor takes three values.
  struct Factor {
    int m;
    float middle, side;
  };

  static std::vector<Factor> factors() {
    std::vector<Factor> all;
    for (int p = 0; p < poles; ++p) {
      const int last = p == 0 ? 8 : 2;  // z^(2 last) is left out
      double power = pole(p), gain = std::pow((1 - power) / (1 - std::pow(power, 2 * last)), 2);
      for (int m = 1; m <= last; m *= 2, power *= power, gain = 1)
        all.push_back({m, float(gain * (1 + power * power)), float(gain * power)});
    }
    return all;
  }

  static void row(const std::vector<Factor>& factors, float* a, float* b, int64_t w, float* out) {
    int64_t first = 0, last = w + 2 * start;
    for (const Factor& f : factors) {
      first += f.m;
      last -= f.m;
      if (&f == &factors.back()) b = out - start, first = start, last = start + w;
      for (int64_t i = first; i < last; i += LANES) {
        const Vector sides = load<Vector>(a + i - f.m) + load<Vector>(a + i + f.m);
        store(f.middle * load<Vector>(a + i) + f.side * sides, b + i);
      }
      std::swap(a, b);
    }
  }

  static void fill(const Frame& frame, Window& window) {
    const int64_t wide = window.w + 2 * start, high = window.h + 2 * start;
    const int64_t pitch = (wide + 5 * LANES) / (4 * LANES) * (4 * LANES);  // at least a vector is spare
    window.raw.resize(pitch * high + 4 * LANES);
    window.line.resize(pitch + 4 * LANES);  // rows are worked on in whole vectors, beyond their ends
    read(frame, window.x0 - start, window.y0 - start, wide, high, pitch, true, window.raw.data());
    columns(window.raw.data(), high, pitch);
    static const std::vector<Factor> all = factors();
    for (int64_t j = 0; j < window.h; ++j)
      row(all, window.raw.data() + (start + j) * pitch, window.line.data(), window.w, window.values.data() + j * window.pitch());
  }
};

// Makes `window` hold what a sampler of `degree` needs between (low) and (high), px, with `slack` px around.
template <int degree>
void open_window(const Frame& frame, const double (&low)[2], const double (&high)[2], double slack, Window& window) {
  window.x0 = int64_t(std::floor(low[0] - slack)) - degree / 2;
  window.y0 = int64_t(std::floor(low[1] - slack)) - degree / 2;
  window.w = int64_t(std::floor(high[0] + slack)) + (degree + 1) / 2 + 1 - window.x0;
  window.h = int64_t(std::floor(high[1] + slack)) + (degree + 1) / 2 + 1 - window.y0;
  window.values.resize(window.pitch() * window.h + Window::SPARE);
  if constexpr (degree == 1) {
    read(frame, window.x0, window.y0, window.w, window.h, window.pitch(), false, window.values.data());
  } else {
    Prefilter<degree>::fill(frame, window);
  }
}

}  // namespace ecc
