// Sampling, linearised (core/linearised.py): the values of patches with their slopes, and the way back, from gradients by
// these values to one by the image.
#pragma once
#include "sample.h"

namespace ecc {

struct View {  // adjoint.VIEW, of patches that all consist of the same pixels
  Frame frame;
  int64_t next_frame;         // from one patch's frame to the next, in pixels
  const double *warp, *pose;  // (B, 2, 3), of pixels to the frame; (B, 3)
  const float *u, *v, *box;   // (N,) each; the corners of the box around them, (2, 4)
  float *values, *image;      // (B, 4, N): g, and d/dx, d/dy, d/dtheta of the pose; or (B, N) by g. By the image: (I, H, W)
  int64_t pixels, count, threads, degree;

  Warp warp_of(int64_t b) const {
    const double* const w = warp + 6 * b;
    return {w[0], w[1], w[3], w[4], w[2], w[5]};
  }
};

// UNIT times the slopes of the weights of `weigh`.
template <int degree, class Real>
void weigh_slopes(Real t, Real (&w)[degree + 1]) {
  const Real r = 1 - t, t2 = t * t, r2 = r * r;
  if constexpr (degree == 1) {
    w[0] = t - t - 1.f;
    w[1] = t - t + 1.f;
  } else if constexpr (degree == 3) {
    w[0] = -3.f * r2;
    w[1] = t * (9.f * t - 12.f);
    w[2] = r * (12.f - 9.f * r);
    w[3] = 3.f * t2;
  } else {
    w[0] = -5.f * r2 * r2;
    w[5] = 5.f * t2 * t2;
    w[1] = -5.f - r * (20.f + r * (30.f + r * (20.f - 25.f * r)));
    w[4] = 5.f + t * (20.f + t * (30.f + t * (20.f - 25.f * t)));
    w[2] = t * (t2 * (120.f - 50.f * t) - 120.f);
    w[3] = r * (r2 * (50.f * r - 120.f) + 120.f);
  }
}

// The window around patch b and what takes its pixels there. False if it lies beyond the frame.
template <int degree>
bool place(const View& view, int64_t b, Window& window, Warp& there) {
  const Warp warp = view.warp_of(b);
  double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL};
  for (int k = 0; k < 4; ++k) {
    const double u = view.box[k], v = view.box[4 + k], point[2] = {warp.x(u, v), warp.y(u, v)};
    for (int d = 0; d < 2; ++d) low[d] = std::min(low[d], point[d]), high[d] = std::max(high[d], point[d]);
  }
  if (!(high[0] >= 0 && high[1] >= 0 && low[0] < double(view.frame.w) && low[1] < double(view.frame.h))) return false;
  place_window<degree>(low, high, 1, window);
  there = warp;
  there.x0 -= double(window.x0 + degree / 2), there.y0 -= double(window.y0 + degree / 2);
  return true;
}

// body(first, line) for each row of neighbouring pixels.
template <class Body>
void lines(const View& view, const Warp& there, Body body) {
  const float *const u = view.u, *const v = view.v;
  for (int64_t first = 0, last; first < view.pixels; first = last) {
    const auto on = [&](int64_t i) {  // they are in order, row by row
      return i < view.pixels && v[i] == v[first] && u[i] - u[first] == float(i - first);
    };
    for (last = first + 1; on(last + LANES - 1);) last += LANES;
    while (on(last)) ++last;
    const double x = there.x(u[first], v[first]), y = there.y(u[first], v[first]);
    body(first, Line{float(x), float(y), float(there.xu), float(there.yu), int(last - first)});
  }
}

inline Vector clamped(const Vector& v, float most) { return v > most ? Vector{} + most : v > 0.f ? v : Vector{}; }

// `runs` of any line: the body has a place for each where neighbours do not have neighbouring taps.
template <int degree, class Body>
void vectors(const Window& window, const Line& line, Body body) {
  if (straight(line)) return runs<degree>(window, line, body);
  constexpr float BELOW_ONE = 0.99999f;
  const float right = float(window.w - degree - 1) + BELOW_ONE, bottom = float(window.h - degree - 1) + BELOW_ONE;
  Vector lane;
  for (int k = 0; k < LANES; ++k) lane[k] = float(k);
  for (int i = 0; i < line.n; i += LANES, lane += float(LANES)) {
    const Vector x = clamped(line.x + lane * line.dx, right), y = clamped(line.y + lane * line.dy, bottom);
    const Ints ix = __builtin_convertvector(x, Ints), iy = __builtin_convertvector(y, Ints);
    const Vector fx = x - __builtin_convertvector(ix, Vector), fy = y - __builtin_convertvector(iy, Vector);
    body(Ints(iy * int32_t(window.pitch()) + ix), i, line.n - i, fx, fy, lane);
  }
}

template <int l>
Vector tap(const float* from, int64_t at) {
  return load<Vector>(from + at + l);
}

// Value l behind each place: of a transpose, whose steps but for the last are the same for all l.
template <int l, int size = LANES>
[[gnu::always_inline]] inline Vector tap(const float* from, const Ints& places) {
#if defined(__clang__) || defined(__AVX__)
  if constexpr (size == 1)
    return load<Vector>(from + places[l]);
  else
    return after<l % 2 * LANES / 2, 2>(tap<l / 2, size / 2>(from, places),
                                       tap<l / 2 + LANES / 2, size / 2>(from, places));
#else  // g++ shuffles one by one
  float taps[LANES];
  for (int k = 0; k < LANES; ++k) taps[k] = from[places[k] + l];
  return load<Vector>(taps);
#endif
}

// Adds the products of wx and wy to the taps.
template <int degree>
void add(float* values, int64_t pitch, int64_t at, int, const Vector (&wx)[degree + 1], const Vector (&wy)[degree + 1]) {
  for (int k = 0; k <= degree; ++k) {
    float* const to = values + at + k * pitch;
    Vector near = load<Vector>(to), beyond = load<Vector>(to + LANES);
    [&]<int... l>(std::integer_sequence<int, l...>) {  // the l-th tap is l values farther on
      ((near += after<LANES - l>(Vector{}, wy[k] * wx[l])), ...);
      ((beyond += after<LANES - l>(wy[k] * wx[l], Vector{})), ...);
    }(std::make_integer_sequence<int, degree + 1>());
    store(near, to);
    store(beyond, to + LANES);
  }
}

template <int degree>
void add(float* values, int64_t pitch, const Ints& places, int n, const Vector (&wx)[degree + 1],
         const Vector (&wy)[degree + 1]) {
  constexpr int size = degree == 5 ? 8 : degree + 1;
  typedef float Taps __attribute__((vector_size(4 * size)));  // of a row
  for (int j = 0; j < LANES; ++j) {
    const int i = j % 4 * (LANES / 4) + j / 4;  // neighbours would wait for each other's sums
    if (i >= n) continue;
    Taps row, sum;
    float weights[size] = {};
    for (int l = 0; l <= degree; ++l) weights[l] = wx[l][i];
    std::memcpy(&row, weights, sizeof row);
    float* to = values + places[i];
    for (int k = 0; k <= degree; ++k, to += pitch) {
      std::memcpy(&sum, to, sizeof sum);
      sum += wy[k][i] * row;
      std::memcpy(to, &sum, sizeof sum);
    }
  }
}

// values, (4, N) of patch b.
template <int degree>
void linearise(const View& view, int64_t b) {
  constexpr int taps = degree + 1;
  constexpr float unit = 1 / (UNIT[degree] * UNIT[degree]);
  thread_local Window window;
  Warp there;
  const int64_t n = view.pixels;
  float* const out = view.values + b * 4 * n;
  if (!place<degree>(view, b, window, there)) return void(std::fill_n(out, 4 * n, 0.f));
  fill_window<degree>(view.frame.after(b * view.next_frame), window);
  const Warp warp = view.warp_of(b);
  lines(view, there, [&](int64_t first, const Line& line) {
    // from the pose: of the line's first pixel
    const float x = float(warp.x(view.u[first], view.v[first]) - view.pose[3 * b]);
    const float y = float(warp.y(view.u[first], view.v[first]) - view.pose[3 * b + 1]);
    vectors<degree>(window, line, [&](auto at, int i, int left, const Vector& fx, const Vector& fy, const Vector& lane) {
      Vector wx[taps], wy[taps], dx[taps], dy[taps], sum[4]{};
      weigh<degree, Vector>(fx, wx);
      weigh<degree, Vector>(fy, wy);
      weigh_slopes<degree, Vector>(fx, dx);
      weigh_slopes<degree, Vector>(fy, dy);
      for (int k = 0; k < taps; ++k) {
        const float* const values = window.values.data() + k * window.pitch();
        Vector row{}, along{};
        [&]<int... l>(std::integer_sequence<int, l...>) {
          const Vector value[] = {tap<l>(values, at)...};
          ((row += wx[l] * value[l], along += dx[l] * value[l]), ...);
        }(std::make_integer_sequence<int, taps>());
        sum[0] += wy[k] * row;
        sum[1] += wy[k] * along;
        sum[2] += dy[k] * row;
      }
      sum[3] = sum[1] * (y + line.dy * lane) - sum[2] * (x + line.dx * lane);  // eq. (2): d(x, y) / dtheta = (y, -x)
      for (int k = 0; k < 4; ++k) {
        const Vector scaled = sum[k] * unit;
        float* const to = out + k * n + first + i;
        const bool whole = first + i + LANES <= n;  // what follows is yet to come
        whole ? store(scaled, to) : void(std::memcpy(to, &scaled, 4 * std::min(left, LANES)));
      }
    });
  });
}

// Adds what the gradient by patch b's values makes of that by its frame.
template <int degree>
void spread(const View& view, int64_t b) {
  constexpr int taps = degree + 1;
  constexpr float unit = 1 / (UNIT[degree] * UNIT[degree]);
  thread_local Window window;
  Warp there;
  if (!place<degree>(view, b, window, there)) return;
  window.values.assign(window.values.size(), 0);
  const float* const by = view.values + b * view.pixels;
  lines(view, there, [&](int64_t first, const Line& line) {
    vectors<degree>(window, line, [&](auto at, int i, int left, const Vector& fx, const Vector& fy, const Vector& lane) {
      Vector wx[taps], wy[taps], value{};
      const int n = std::min(left, LANES);
      const bool whole = first + i + LANES <= view.pixels;
      whole ? void(value = load<Vector>(by + first + i)) : void(std::memcpy(&value, by + first + i, 4 * n));
      value = lane < float(i + n) ? value : Vector{};
      weigh<degree, Vector>(fx, wx);
      weigh<degree, Vector>(fy, wy);
      for (int l = 0; l < taps; ++l) wx[l] *= value * unit;
      add<degree>(window.values.data(), window.pitch(), at, n, wx, wy);
    });
  });
  empty_window<degree>(window, view.frame.h, view.frame.w, view.image + b * view.next_frame);
}

}  // namespace ecc
