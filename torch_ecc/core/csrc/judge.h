// torch_ecc/judge.py for one template that lies wholly in the frame: see there for the formulae and the constants.
#pragma once
#include <array>

#include "solve.h"

namespace ecc {

enum Status : int8_t { CONVERGED, MAX_ITERATIONS, LOST, OUT_OF_VIEW, LOW_TEXTURE };
constexpr double LARGEST_SIGMA = 0.5, NOISE_SHARE = 0.6, DOUBTFUL_SHARE = 0.5, PI = 3.14159265358979323846;
constexpr int64_t FEW_BLOCKS = 4;

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

struct Remains {  // of a patch v after the fit, and before it: weighted sums, and what K's rows make of the rest
  double square, v, vv, vt;  // of the rest squared; of v, v^2 and v (t - level)
  double clustered[3];       // of the squared sums over blocks
};

// From the sums of the last look, r = v - R^T model, and the fit e = r - R^T change.
inline Remains remains(const Template& t, Scratch& scratch) {
  const Pixels& p = t.whole;
  const Coefficients &model = scratch.model, &change = scratch.change;
  Remains out{};
  double moved;
  out.square = left_over(t, scratch, moved);
  out.vv = scratch.sums.squares;
  for (int c = 3; c < MOST; ++c) {
    const double of_r = along(t, c, scratch.sums), of_v = of_r + along(t, c, model);
    out.vv += model[c] * (of_r + of_v);
    if (c == 3) out.vt = of_v;
    if (c == 4) out.v = of_v;
  }
  const int64_t columns = 5 + t.light(), pitch = t.parts_pitch;
  const int16_t* part = t.at<int16_t>(t.parts);
  const float* lines = scratch.lines.data();
  float *const line = scratch.rest.data(), *const room = line + 3 * (p.pitch + BLOCK);
  float taken[3][MOST];
  for (int k = 0; k < 3; ++k)
    for (int c = 0; c < MOST; ++c) taken[k][c] = float(change[c]) * t.part[k][c];
  Vector squares[3] = {};
  for (int64_t first = 0; first < p.height; first += BLOCK, lines += lines_of(t) * p.pitch) {
    blocks(t, lines, line, {room, room + pitch, room + 2 * pitch});
    for (int k = 0; k < 3; ++k, part += columns * pitch)
      for (int64_t b = 0; b < pitch; b += LANES) {
        Vector rest = load<Vector>(room + k * pitch + b);
        for (int64_t c = 0; c < columns; ++c) rest -= taken[k][c] * wide(part + c * pitch + b);
        squares[k] += rest * rest;
      }
  }
  for (int k = 0; k < 3; ++k)
    for (int l = 0; l < LANES; ++l) out.clustered[k] += squares[k][l];
  return out;
}

// judge.flat_correlation: what is left of the correlation when both lose their planes 1, x', y'.
inline double flat_correlation(const Template& t, const float* patch) {
  const Pixels& p = t.whole;
  const int16_t* rt = t.at<int16_t>(p.t);
  const float* weight = t.at<float>(p.weight);
  Matrix normal{}, inverse;
  double a[3] = {}, b[3] = {}, tt = 0, gg = 0, tg = 0;
  for (int64_t y = 0; y < p.height; ++y)
    for (int64_t x = 0; x < p.width; ++x) {
      const double w = weight[y * p.weight_pitch + x], T = double(p.grey) * rt[y * p.pitch + x];
      const double g = patch[y * p.pitch + x];
      const double plane[3] = {1, (p.left + double(x)) / t.radius, (p.top + double(y)) / t.radius};
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
  const Remains left = remains(t, scratch);
  const double w = t.gram[4][4], wt = t.gram[3][4], dt = std::sqrt(std::max(t.gram[3][3] - wt * wt / w, 0.0)),
               dg = std::sqrt(std::max(left.vv - left.v * left.v / w, 0.0));
  Verdict v;
  v.score = dt * dg > 1e-12 * left.vv ? std::clamp((left.vt - wt * left.v / w) / (dt * dg), -1.0, 1.0) : 0;
  const double alike = v.score >= set.min_score ? v.score : std::max(v.score, flat_correlation(t, scratch.patch.data()));
  const double gain = finite(scratch.gain());
  v.power = finite(left.square / std::max(w, 1e-30));
  constexpr double NOISE_GAIN[] = {4.0 / 9, 0.7643, 0.8427};  // sampling.NOISE_GAIN
  const double noise = v.power * double(t.count) / std::max(double(t.count) - double(t.columns), 1.0) /
                       (gain * gain + NOISE_GAIN[set.degree / 2]);
  double structure[3] = {1, 1, 1};
  for (int k = 0; k < 3 && t.blocks >= FEW_BLOCKS * t.columns; ++k) {
    const double few = double(t.blocks) / double(t.blocks - t.columns);
    const double white = std::max(t.white[k] * noise * (1 + gain * gain), 1e-30);
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
