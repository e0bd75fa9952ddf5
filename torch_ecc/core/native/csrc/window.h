// The neighbourhood of a patch as float32: read from the frame in its own dtype, prefiltered if a spline is asked for.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

namespace ecc {

#ifdef __AVX512F__
constexpr int LANES = 16;
#else
constexpr int LANES = 8;
#endif
typedef float Vector __attribute__((vector_size(4 * LANES)));
constexpr int WIDEST = 16;  // lanes of sums: of one order, and so of one rounding, whatever the processor's vectors are
typedef float Wide __attribute__((vector_size(4 * WIDEST)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef int16_t Shorts __attribute__((vector_size(2 * LANES)));

template <class V, class T>
V load(const T* from) {
  V values;
  std::memcpy(&values, from, sizeof values);
  return values;
}

// The values from the n-th of `a` on, continued by those of `b`; of `by` = 2 those of both by turns.
template <int n, int by = 1, int... k>
Vector after(const Vector& a, const Vector& b, std::integer_sequence<int, k...>) {
#ifdef __clang__
  return __builtin_shufflevector(a, b, (k / by + n + k % by * LANES)...);
#else
  return __builtin_shuffle(a, b, Ints{(k / by + n + k % by * LANES)...});
#endif
}

template <int n, int by = 1>
Vector after(const Vector& a, const Vector& b) {
  return after<n, by>(a, b, std::make_integer_sequence<int, LANES>());
}

inline void store(const Vector& values, float* to) { std::memcpy(to, &values, sizeof values); }

inline int64_t padded(int64_t n) { return (n + WIDEST - 1) / WIDEST * WIDEST; }

struct Frame {  // rows of one grey frame where they are: uint8, uint16 or float32, told by its bytes
  const char* data;
  int64_t bytes, h, w, stride;

  Frame after(int64_t pixels) const { return {data + pixels * bytes, bytes, h, w, stride}; }
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
    return reinterpret_cast<const Pixel*>(frame.data) + within(y0 + j, frame.h, mirrored) * frame.stride;
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
  const auto rows = frame.bytes == 1 ? read_rows<uint8_t> : frame.bytes == 2 ? read_rows<uint16_t> : read_rows<float>;
  rows(frame, x0, y0, w, h, pitch, mirrored, out);
}

// Samples to coefficients of the interpolating B-spline, one pole z of the inverse filter after the other (Unser et
// al., 1993, I).
template <int degree>
struct Prefilter {
  static constexpr int poles = degree / 2;
  // px from where reading begins or ends to where all but 4e-5 of that is forgotten
  static constexpr int64_t start = degree == 3 ? 8 : 12;

  static double pole(int p) {
    const double inner = std::sqrt(17745.0 / 4), outer = std::sqrt(105.0 / 4);
    if (degree == 3) return std::sqrt(3.0) - 2;
    return p == 0 ? std::sqrt(67.5 - inner) + outer - 6.5 : std::sqrt(67.5 + inner) - outer - 6.5;
  }

  // out = now * row + before * last, (pitch,) each.
  static void recur(const float* row, float now, const float* last, float before, int64_t pitch, float* out) {
    for (int64_t i = 0; i < pitch; i += LANES)
      store(now * load<Vector>(row + i) + before * load<Vector>(last + i), out + i);
  }

  // Down the columns and up again, recursively, started as if the border went on.
  static void columns(float* values, int64_t h, int64_t pitch) {
    float* const end = values + (h - 1) * pitch;
    for (int p = 0; p < poles; ++p) {
      const float z = float(pole(p)), rest = 1 - z;
      recur(values, rest, values, 0, pitch, values);
      for (float* at = values + pitch; at <= end; at += pitch) recur(at, rest * rest, at - pitch, z, pitch, at);
      recur(end, 1 / rest, end, 0, pitch, end);
      for (float* at = end - pitch; at >= values; at -= pitch) recur(at, 1, at + pitch, z, pitch, at);
    }
  }

  // Along the rows 1 / ((1 - z S) (1 - z / S)), S a shift by one px, is the product over m = 1, 2, 4 ... of
  // (1 + z^m S^m) (1 + z^m / S^m), so that each factor takes three values: the first where they lie in memory, the
  // others, one after the other, in registers.
  template <int m>
  struct Factor {
    float middle, side;
    Vector before{}, now{};

    Factor(int p, int last) {  // z^(2 last) is left out
      const double power = std::pow(pole(p), m), gain = std::pow((1 - pole(p)) / (1 - std::pow(pole(p), 2 * last)), 2);
      middle = float((m == 1 ? gain : 1) * (1 + power * power));
      side = float((m == 1 ? gain : 1) * power);
    }

    Vector operator()(const Vector& next) {  // of the vector before this one
      const Vector sides = after<LANES - m>(before, now) + after<m>(now, next), out = middle * now + side * sides;
      before = now;
      now = next;
      return out;
    }
  };

  static void row(const float* from, int64_t n, float* out) {
    static const Factor<1> first(0, 8), e(1, 2);
    static const Factor<2> b(0, 8), f(1, 2);
    static const Factor<4> c(0, 8);
    static const Factor<8> d(0, 8);
    const auto go = [&](auto... factors) {
      for (int64_t i = 0; i < n + int64_t(sizeof...(factors)) * LANES; i += LANES) {
        const Vector sides = load<Vector>(from + i - 1) + load<Vector>(from + i + 1);
        Vector value = first.middle * load<Vector>(from + i) + first.side * sides;
        ((value = factors(value)), ...);
        const int64_t at = i - int64_t(sizeof...(factors)) * LANES;
        if (at >= 0) store(value, out + at);
      }
    };
    if constexpr (degree == 3)
      go(b, c, d);
    else
      go(b, c, d, e, f);
  }

  static void fill(const Frame& frame, Window& window) {
    const int64_t high = window.h + 2 * start, pitch = padded(window.w + 2 * start);
    window.raw.resize(pitch * high);
    read(frame, window.x0 - start, window.y0 - start, pitch, high, pitch, true, window.raw.data());
    columns(window.raw.data(), high, pitch);
    window.line.resize(pitch + LANES);
    for (int64_t j = 0; j < window.h; ++j) {
      row(window.raw.data() + (start + j) * pitch, start + window.w, window.line.data());
      std::copy_n(window.line.data() + start, window.w, window.values.data() + j * window.pitch());
    }
  }

  // The transpose of that up to what is read: filters are even, and what they end with is next to 0.
  static void spread(Window& window) {
    const int64_t high = window.h + 2 * start, pitch = padded(window.w + 2 * start);
    window.raw.assign(pitch * high, 0);
    window.line.resize(pitch + LANES);
    float* at = window.raw.data() + start * pitch;
    for (int64_t j = 0; j < window.h; ++j)
      std::copy_n(window.values.data() + j * window.pitch(), window.w, at + j * pitch + start);
    for (int64_t j = 0; j < window.h; ++j, at += pitch) {
      row(at, pitch, window.line.data());
      std::copy_n(window.line.data(), pitch, at);
    }
    columns(window.raw.data(), high, pitch);
  }
};

// Puts `window` where a sampler of `degree` needs values between (low) and (high), px, with `slack` px around.
template <int degree>
void place_window(const double (&low)[2], const double (&high)[2], double slack, Window& window) {
  window.x0 = int64_t(std::floor(low[0] - slack)) - degree / 2;
  window.y0 = int64_t(std::floor(low[1] - slack)) - degree / 2;
  window.w = int64_t(std::floor(high[0] + slack)) + (degree + 1) / 2 + 1 - window.x0;
  window.h = int64_t(std::floor(high[1] + slack)) + (degree + 1) / 2 + 1 - window.y0;
  window.values.resize(window.pitch() * window.h + Window::SPARE);
}

template <int degree>
void fill_window(const Frame& frame, Window& window) {
  if constexpr (degree == 1) {
    read(frame, window.x0, window.y0, window.w, window.h, window.pitch(), false, window.values.data());
  } else {
    Prefilter<degree>::fill(frame, window);
  }
}

// Adds `values`, (h, w) of rows that lie `pitch` apart, to where `read` would have them from in an image (high, wide).
inline void add_rows(const float* values, int64_t x0, int64_t y0, int64_t w, int64_t h, int64_t pitch, bool mirrored,
                     int64_t high, int64_t wide, float* image) {
  const int64_t first = std::clamp<int64_t>(-x0, 0, w), last = std::clamp<int64_t>(wide - x0, first, w);
  for (int64_t j = 0; j < h; ++j, values += pitch) {
    float* const row = image + within(y0 + j, high, mirrored) * wide;
    for (int64_t i = 0; i < first; ++i) row[within(x0 + i, wide, mirrored)] += values[i];
    for (int64_t i = first; i < last; ++i) row[x0 + i] += values[i];
    for (int64_t i = last; i < w; ++i) row[within(x0 + i, wide, mirrored)] += values[i];
  }
}

// The transpose of `fill_window`: adds what the window's values bring to an image (high, wide).
template <int degree>
void empty_window(Window& window, int64_t high, int64_t wide, float* image) {
  const int64_t x0 = window.x0, y0 = window.y0, w = window.w, h = window.h;
  if constexpr (degree == 1) {
    add_rows(window.values.data(), x0, y0, w, h, window.pitch(), false, high, wide, image);
  } else {
    const int64_t start = Prefilter<degree>::start, all = h + 2 * start, pitch = padded(w + 2 * start);
    Prefilter<degree>::spread(window);
    add_rows(window.raw.data(), x0 - start, y0 - start, w + 2 * start, all, pitch, true, high, wide, image);
  }
}

}  // namespace ecc
