// The neighbourhood of a patch as float32: read from the frame in its own dtype, prefiltered if a spline is asked for.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace ecc {

struct Frame {  // rows of one grey frame where they are, in any of the three dtypes
  const void* data;
  int64_t h, w, stride;
  enum { U8, U16, F32 } dtype;
};

struct Window {  // values at frame positions (x0 .. x0 + w - 1, y0 .. y0 + h - 1); rows are w + SPARE apart
  static constexpr int64_t SPARE = 8;  // a row is read in whole vectors, at most so far beyond its end
  int64_t x0 = 0, y0 = 0, w = 0, h = 0;
  std::vector<float> values, raw, turned;
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
  const int64_t first = std::clamp<int64_t>(-x0, 0, w), last = std::clamp<int64_t>(frame.w - x0, first, w);
  for (int64_t j = 0; j < h; ++j, out += pitch) {
    const Pixel* row = static_cast<const Pixel*>(frame.data) + within(y0 + j, frame.h, mirrored) * frame.stride;
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

constexpr int64_t VECTOR = 4;

// out (w, h) = in (h, w) transposed, rows `to` and `from` apart, in tiles of columns. h counts up to the next VECTOR.
inline void transpose(const float* __restrict in, int64_t h, int64_t w, int64_t from, float* __restrict out, int64_t to) {
  constexpr int64_t TILE = 16;
  for (int64_t i = 0; i < w; i += TILE)
    for (int64_t j = 0; j < h; j += VECTOR)
      for (int64_t a = i; a < std::min(i + TILE, w); ++a) {
        const float *c = in + j * from + a;
        const float b[4] = {c[0], c[from], c[2 * from], c[3 * from]};
        std::copy(b, b + 4, out + a * to + j);
      }
}

// Samples to coefficients of the interpolating B-spline, down the columns of (h, w): the recursions of Unser et al.
// (1993, I) from both ends, started as if the border went on; that is forgotten 1e-6 after so many pixels as `start`.
template <int degree>
struct Prefilter {
  static constexpr int start = degree == 3 ? 11 : 17;

  static void columns(float* values, int64_t h, int64_t w) {
    const double inner = std::sqrt(17745.0 / 4), outer = std::sqrt(105.0 / 4);
    const double poles[2] = {degree == 3 ? std::sqrt(3.0) - 2 : std::sqrt(67.5 - inner) + outer - 6.5,
                             std::sqrt(67.5 + inner) - outer - 6.5};
    for (int p = 0; p < degree / 2; ++p) {
      const float z = float(poles[p]), rest = 1 - z;
      for (int64_t i = 0; i < w; ++i) values[i] *= rest;
      for (int64_t j = 1; j < h; ++j) add(values + j * w, rest * rest, values + (j - 1) * w, z, w);
      for (int64_t i = 0; i < w; ++i) values[(h - 1) * w + i] /= rest;
      for (int64_t j = h - 2; j >= 0; --j) add(values + j * w, 1, values + (j + 1) * w, z, w);
    }
  }

  static void add(float* __restrict row, float gain, const float* __restrict last, float z, int64_t w) {
    for (int64_t i = 0; i < w; ++i) row[i] = gain * row[i] + z * last[i];
  }

  static void fill(const Frame& frame, Window& window) {
    const int64_t wide = window.w + 2 * start, high = window.h + 2 * start, rows = window.h + VECTOR;
    window.raw.resize(wide * (high + VECTOR));
    window.turned.resize((wide + VECTOR) * rows);
    read(frame, window.x0 - start, window.y0 - start, wide, high, wide, true, window.raw.data());
    columns(window.raw.data(), high, wide);
    transpose(window.raw.data() + start * wide, window.h, wide, wide, window.turned.data(), rows);
    columns(window.turned.data(), wide, rows);
    transpose(window.turned.data() + start * rows, window.w, window.h, rows, window.values.data(), window.pitch());
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
