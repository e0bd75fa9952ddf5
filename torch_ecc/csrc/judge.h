// torch_ecc/judge.py for one template that lies wholly in the frame: see there for the formulae and the constants.
#pragma once
#include <array>
#include <numeric>

#include "solve.h"

namespace ecc {

enum Status : int8_t { CONVERGED, MAX_ITERATIONS, LOST, OUT_OF_VIEW, LOW_TEXTURE };
constexpr double LARGEST_SIGMA = 0.5, NOISE_SHARE = 0.6, DOUBTFUL_SHARE = 0.5, PI = 3.14159265358979323846;
constexpr int64_t FEW_BLOCKS = 4, BLOCK = 6;
constexpr int MOST_COLUMNS = 10;

inline bool good(int status) { return status == CONVERGED || status == MAX_ITERATIONS; }

struct Verdict {
  Status status;
  double score, power, covariance[9];
};

using Matrix = std::array<double, 9>;

inline Matrix multiply(const Matrix& a, const Matrix& b, bool transposed = false) {
  Matrix c{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) c[3 * i + j] += a[3 * i + k] * (transposed ? b[3 * j + k] : b[3 * k + j]);
  return c;
}

// reference.safe_inverse of a 3 x 3 matrix; zero, and false, where it is singular to float32.
inline bool safe_inverse(const Matrix& matrix, Matrix& inverse) {
  double scale[3];
  Matrix m;
  bool regular = true;
  for (int i = 0; i < 3; ++i) {
    scale[i] = 1 / std::sqrt(std::max(std::abs(matrix[4 * i]), 1e-30));
    regular = regular && matrix[4 * i] > 0;
  }
  for (int i = 0; i < 9; ++i) m[i] = matrix[i] * scale[i / 3] * scale[i % 3];
  double size = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {  // adjugate
      const int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
      inverse[3 * i + j] = m[3 * a + c] * m[3 * b + d] - m[3 * a + d] * m[3 * b + c];
    }
  const double determinant = m[0] * inverse[0] + m[1] * inverse[3] + m[2] * inverse[6];
  for (int i = 0; i < 9; ++i) size += std::abs(inverse[i] /= determinant);
  regular = regular && size < 1e6;  // NaN and infinity compare as singular
  for (int i = 0; i < 9; ++i) inverse[i] = regular ? inverse[i] * scale[i / 3] * scale[i % 3] : 0;
  return regular;
}

struct Moments {  // sums over the pixels, the grey levels counted from one of their own
  double w = 0, wt = 0, wg = 0, wtt = 0, wgg = 0, wtg = 0, t = 0, g = 0, count = 0;
};

inline Moments moments(const Template& t, const float* patch, float level, float grey) {
  Moments m;
  for (int64_t first = 0; first < t.n; first += CHUNK) {
    const int n = int(std::min<int64_t>(CHUNK, t.n - first));
    const float *weight = t.weight + first, *T = t.level + first, *G = patch + first;
    float s[8] = {};
    int count = 0;
    for (int i = 0; i < n; ++i) {
      const float w = weight[i], a = T[i] - level, b = G[i] - grey;
      s[0] += w;
      s[1] += w * a;
      s[2] += w * b;
      s[3] += w * a * a;
      s[4] += w * b * b;
      s[5] += w * a * b;
      s[6] += a;
      s[7] += b;
      count += w > 0;
    }
    double* sums[] = {&m.w, &m.wt, &m.wg, &m.wtt, &m.wgg, &m.wtg, &m.t, &m.g};
    for (int k = 0; k < 8; ++k) *sums[k] += s[k];
    m.count += count;
  }
  return m;
}

// judge.flat_correlation: what is left of the correlation when both lose their planes 1, x', y'.
inline double flat_correlation(const Template& t, const float* patch, float level, float grey) {
  Matrix normal{}, inverse;
  double a[3] = {}, b[3] = {}, tt = 0, gg = 0, tg = 0;
  for (int64_t i = 0; i < t.n; ++i) {
    const double w = t.weight[i], T = t.level[i] - level, g = patch[i] - grey;
    const double plane[3] = {1, t.px[i] / t.radius, t.py[i] / t.radius};
    for (int j = 0; j < 3; ++j) {
      for (int k = 0; k < 3; ++k) normal[3 * j + k] += w * plane[j] * plane[k];
      a[j] += w * plane[j] * T;
      b[j] += w * plane[j] * g;
    }
    tt += w * T * T;
    gg += w * g * g;
    tg += w * T * g;
  }
  const double whole = gg;
  safe_inverse(normal, inverse);
  for (int j = 0; j < 3; ++j)
    for (int k = 0; k < 3; ++k) {
      tt -= a[j] * inverse[3 * j + k] * a[k];
      gg -= b[j] * inverse[3 * j + k] * b[k];
      tg -= a[j] * inverse[3 * j + k] * b[k];
    }
  return tt > 0 && gg > 1e-12 * whole ? std::clamp(tg / std::sqrt(tt * gg), -1.0, 1.0) : 0;
}

struct Remains {  // of a patch after the fit: weighted square sum, square sums of K's rows and of the blocks' sums
  double square = 0, white[3] = {0, 0, 0}, clustered[3] = {0, 0, 0};
};

// Criterion.fit of n pixels from `first` on: r = g - columns u, t and g less their means.
inline void residual(const Template& t, int64_t first, int64_t n, const float* patch, const float* u, float level,
                     float grey, float* __restrict r) {
  const float *G = t.signal + first, *px = t.px + first, *py = t.py + first;
  const float cx = float(t.centre[0]), sx = float(2 / std::max(t.box[0][2] - t.box[0][0], 1.0));
  const float cy = float(t.centre[1]), sy = float(2 / std::max(t.box[1][2] - t.box[1][0], 1.0));
  for (int64_t i = 0; i < n; ++i) {
    const float T = t.level[first + i], x = (px[i] - cx) * sx, y = (py[i] - cy) * sy;
    const float light = u[5] * x + u[6] * y + u[7] * x * x + u[8] * y * y + u[9] * x * y;
    const float motion = u[0] * G[i] + u[1] * G[t.n + i] + u[2] * G[2 * t.n + i];
    r[i] = patch[first + i] - grey - (motion + u[3] * (T - level) + u[4] + light * T);
  }
}

// The residual's power and the sums of judge.clustering, row by row; `lines` is room for four rows.
inline Remains remains(const Template& t, const float* patch, const float* u, float level, float grey,
                       std::vector<float>& lines) {
  const int64_t width = int64_t(t.box[0][2] - t.box[0][0]) + 1;
  lines.assign(4 * width, 0.f);
  float* const r = lines.data();
  float* const line[3] = {r + width, r + 2 * width, r + 3 * width};  // sums down the columns of a row of blocks
  const auto band = [&](int64_t i) { return int64_t(double(t.py[i]) - t.box[1][0]) / BLOCK; };
  Remains out;
  for (int64_t first = 0, last; first < t.n; first = last) {
    last = first + width;
    const bool full = last <= t.n && t.py[last - 1] == t.py[first];
    if (!full)
      for (last = first; last < t.n && t.py[last] == t.py[first];) ++last;
    const int64_t n = last - first;
    residual(t, first, n, patch, u, level, grey, r);
    const float* weight = t.weight + first;
    float square = 0;
    for (int64_t i = 0; i < n; ++i) square += weight[i] * r[i] * r[i];
    out.square += square;
    for (int k = 0; k < 3; ++k) {
      const float* K = t.K + k * t.n + first;
      float white = 0;
      for (int64_t i = 0; i < n; ++i) white += K[i] * K[i];
      out.white[k] += white;
      float* __restrict sum = line[k];
      if (full)
        for (int64_t i = 0; i < n; ++i) sum[i] += K[i] * r[i];
      else  // a mask has gaps
        for (int64_t i = 0; i < n; ++i) sum[int64_t(double(t.px[first + i]) - t.box[0][0])] += K[i] * r[i];
    }
    if (last < t.n && band(last) == band(first)) continue;
    for (int k = 0; k < 3; ++k) {
      for (int64_t left = 0; left < width; left += BLOCK) {
        const double sum = std::accumulate(line[k] + left, line[k] + std::min(left + BLOCK, width), 0.0);
        out.clustered[k] += sum * sum;
      }
      std::fill(line[k], line[k] + width, 0.f);
    }
  }
  return out;
}

inline double alike(double step, double count) {
  step -= std::nearbyint(step);
  const auto sinc = [](double x) { return x == 0 ? 1 : std::sin(PI * x) / (PI * x); };
  return sinc(count * step) / sinc(step);
}

// judge.pose_covariance with the scatter's structure and the sampler's own error; whether the texture fixes the pose.
inline bool covariance(const Template& t, double noise, double gain, const double (&structure)[3],
                       const double (&pose)[3], int64_t degree, double* out) {
  const double own = std::min(noise, t.noise * t.noise), frame = 1 / std::max(gain * gain, 1e-12);
  Matrix slope, spread, inverse;
  for (int i = 0; i < 9; ++i) {
    slope[i] = t.slope[i] - own * t.inflation[i];
    spread[i] = (1 + frame) * t.spread[i] - own * t.spread_noise[i];
  }
  const bool regular = safe_inverse(slope, inverse);
  Matrix local = multiply(multiply(inverse, spread), inverse, true);
  for (int i = 0; i < 9; ++i) local[i] *= noise * structure[i / 3] * structure[i % 3];
  if (degree < 5) {  // judge.interpolation_error
    const double* shift = t.alias + (degree == 1 ? 0 : 6);
    const double same = alike(std::cos(pose[2]), t.box[0][2] - t.box[0][0] + 1) *
                        alike(std::sin(pose[2]), t.box[1][2] - t.box[1][0] + 1);
    for (int i = 0; i < 9; ++i) {
      const double *a = shift + 2 * (i / 3), *b = shift + 2 * (i % 3);
      local[i] += (a[0] * b[0] + a[1] * b[1]) * same * same / 2;
    }
  }
  const double c = std::cos(pose[2]), s = std::sin(pose[2]);
  const Matrix turn = {c, s, 0, -s, c, 0, 0, 0, 1}, turned = multiply(multiply(turn, local), turn, true);
  std::copy(turned.begin(), turned.end(), out);
  const double corner = out[0] + out[4] + out[8] * t.radius * t.radius;
  return regular && own * t.noise_share < NOISE_SHARE && corner < LARGEST_SIGMA * LARGEST_SIGMA;
}

inline double finite(double value) { return std::isfinite(value) ? value : 0; }

inline Verdict judge(const Template& t, const Settings& set, const State& state, Scratch& scratch) {
  const float* patch = scratch.patch.data();
  float level = t.level[t.n / 2], grey = patch[t.n / 2];
  const Moments m = moments(t, patch, level, grey);
  const double dt = std::sqrt(std::max(m.wtt - m.wt * m.wt / m.w, 0.0)),
               dg = std::sqrt(std::max(m.wgg - m.wg * m.wg / m.w, 0.0));
  const double raw = m.wgg + 2 * grey * m.wg + double(grey) * grey * m.w;
  Verdict v;
  v.score = dt * dg > 1e-12 * raw ? std::clamp((m.wtg - m.wt * m.wg / m.w) / (dt * dg), -1.0, 1.0) : 0;
  float u[MOST_COLUMNS] = {0, 0, 0, 1};  // SSD: t as it is
  if (t.light == SSD) {
    grey = level;
  } else {
    level += float(m.t / double(t.n));
    grey += float(m.g / double(t.n));
    for (int64_t r = 0; r < t.p; ++r) {
      double sum = r < 4 ? scratch.u[r] : 0;  // the step has needed these
      for (int64_t first = 0; r >= 4 && first < t.n; first += CHUNK) {
        float part = 0;
        for (int64_t i = first; i < std::min<int64_t>(first + CHUNK, t.n); ++i)
          part += t.K[r * t.n + i] * (patch[i] - grey);
        sum += part;
      }
      u[r] = float(sum);
    }
  }
  const double alike = v.score >= set.min_score ? v.score : std::max(v.score, flat_correlation(t, patch, level, grey));
  const Remains left = remains(t, patch, u, level, grey, scratch.lines);
  const double gain = finite(u[3]);
  v.power = finite(left.square / std::max(m.w, 1e-30));
  constexpr double NOISE_GAIN[] = {4.0 / 9, 0.7643, 0.8427};  // sampling.NOISE_GAIN
  const double noise = v.power * m.count / std::max(m.count - double(t.p), 1.0) /
                       (gain * gain + NOISE_GAIN[set.degree / 2]);
  double structure[3] = {1, 1, 1};
  for (int k = 0; k < 3 && t.blocks >= FEW_BLOCKS * t.p; ++k) {
    const double few = double(t.blocks) / double(t.blocks - t.p);
    const double white = std::max(left.white[k] * noise * (1 + gain * gain), 1e-30);
    structure[k] = std::sqrt(std::max(few * left.clustered[k] / white, 1.0));
  }
  const bool fixed = covariance(t, noise, gain, structure, state.pose, set.degree, v.covariance);
  const bool match = alike >= set.min_score && gain > 0;
  v.status = state.error <= set.tolerance ? CONVERGED : MAX_ITERATIONS;
  if (!fixed) v.status = LOW_TEXTURE;
  if (!match) v.status = t.noise * t.noise * t.noise_share > DOUBTFUL_SHARE ? LOW_TEXTURE : LOST;
  return v;
}

}  // namespace ecc
