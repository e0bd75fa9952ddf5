// torch_ecc.Reference to the bytes of a Template.
#pragma once
#include <ATen/core/Tensor.h>
#include <ATen/ops/zeros.h>

#include <numeric>

#include "solve.h"

namespace ecc {

// The tensors of torch_ecc.Reference in their order, without the criterion.
enum Field { PIXELS, BOX, BLOCKS, BLOCK_SIZES, CENTRE, RADIUS, NOISE, SIGNAL, INSTRUMENT, TRUST, WEIGHT, ALIAS, K, SLOPE,
             SPREAD, INFLATION, SPREAD_NOISE, SHARE, SPARSE, K_SPARSE };

// Gauss-Jordan, with rows and columns brought to unit diagonal first; zero if singular.
inline void invert(double (&matrix)[MOST][MOST], int64_t n) {
  double scale[MOST], wide[MOST][2 * MOST] = {};
  for (int64_t i = 0; i < n; ++i) scale[i] = 1 / std::sqrt(std::max(std::abs(matrix[i][i]), 1e-300));
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t j = 0; j < n; ++j) wide[i][j] = matrix[i][j] * scale[i] * scale[j];
    wide[i][n + i] = 1;
  }
  for (int64_t k = 0; k < n; ++k) {
    int64_t best = k;
    for (int64_t i = k; i < n; ++i)
      if (std::abs(wide[i][k]) > std::abs(wide[best][k])) best = i;
    std::swap(wide[k], wide[best]);
    const double pivot = wide[k][k];
    for (double& value : wide[k]) value /= pivot;
    for (int64_t i = 0; i < n; ++i)
      for (int64_t j = 2 * n - 1; i != k && j >= k; --j) wide[i][j] -= wide[i][k] * wide[k][j];
  }
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) {
      const double value = wide[i][n + j] * scale[i] * scale[j];
      matrix[i][j] = std::isfinite(value) ? value : 0;
    }
}

struct Packer {
  std::vector<at::Tensor> fields;
  int64_t criterion;
  std::vector<int64_t> all, some;  // pixels of the whole and of the thin template

  Packer(at::TensorList reference, int64_t criterion) : criterion(criterion) {
    for (const at::Tensor& tensor : reference) fields.push_back(tensor.contiguous());
    all.resize(fields[PIXELS].size(1));
    std::iota(all.begin(), all.end(), 0);
    const int64_t* sparse = fields[SPARSE].const_data_ptr<int64_t>();
    some.assign(sparse, sparse + fields[SPARSE].size(0));
  }

  template <class T>
  const T* of(Field field, int64_t b) const {
    const at::Tensor& tensor = fields[field];
    return tensor.const_data_ptr<T>() + (tensor.size(0) == 1 ? 0 : b) * (tensor.numel() / tensor.size(0));
  }
  int64_t place(int64_t i, int axis) const {  // column or row in the bounding box
    return int64_t(std::lround(fields[PIXELS].const_data_ptr<float>()[axis * int64_t(all.size()) + i] -
                               fields[BOX].const_data_ptr<float>()[4 * axis]));
  }

  // Shape of the grid of `chosen` pixels, and where its arrays lie behind `end`, which moves on.
  Pixels shape(const std::vector<int64_t>& chosen, bool whole, int64_t& end) const {
    Pixels p{};
    int64_t step = 0;
    for (int64_t i : chosen) step = std::gcd(std::gcd(step, place(i, 0)), place(i, 1));
    step = std::max<int64_t>(step, 1);
    for (int64_t i : chosen) {
      p.width = std::max(p.width, place(i, 0) / step + 1);
      p.height = std::max(p.height, place(i, 1) / step + 1);
    }
    p.step = double(step);
    p.pitch = padded(p.width);
    const bool even = fields[WEIGHT].size(0) == 1 && int64_t(chosen.size()) == p.width * p.height &&
                      fields[WEIGHT].eq(1).all().item<bool>();
    p.weight_pitch = even ? 0 : p.pitch;  // one row serves if all are alike
    const auto take = [&](int64_t bytes) { return std::exchange(end, (end + bytes + 63) / 64 * 64); };
    p.weight = take(4 * p.pitch * (even ? 1 : p.height));
    for (int64_t& at : p.z.at) at = take(2 * p.pitch * p.height);
    for (int64_t& at : p.r.at) at = whole ? take(2 * p.pitch * p.height) : 0;
    return p;
  }

  // Values (3, N) of `chosen` pixels, the first two in one unit and the third less its mean, as integers.
  void round(const Pixels& p, const std::vector<int64_t>& chosen, const float* const (&from)[3], Images& images,
             char* block) const {
    double sum = 0;
    for (int64_t i : chosen) sum += from[2][i];
    images.level = float(sum / double(chosen.size()));
    const auto level = [&](int k) { return k == 2 ? images.level : 0.f; };
    float most[3] = {1e-30f, 1e-30f, 1e-30f};
    for (int k = 0; k < 3; ++k)
      for (int64_t i : chosen) most[k] = std::max(most[k], std::abs(from[k][i] - level(k)));
    images.gradient = std::max(most[0], most[1]) / 32767;
    images.grey = most[2] / 32767;
    for (int k = 0; k < 3 && images.at[k] > 0; ++k) {
      int16_t* const to = reinterpret_cast<int16_t*>(block + images.at[k]);
      for (int64_t i : chosen) {
        const float value = (from[k][i] - level(k)) / (k == 2 ? images.grey : images.gradient);
        to[at(p, i)] = int16_t(std::lround(std::clamp(value, -32767.f, 32767.f)));
      }
    }
  }

  int64_t at(const Pixels& p, int64_t i) const {
    return place(i, 1) / int64_t(p.step) * p.pitch + place(i, 0) / int64_t(p.step);
  }

  void fill(Pixels& p, const std::vector<int64_t>& chosen, int64_t b, Template& t) const {
    const int64_t n = int64_t(all.size());
    char* const block = reinterpret_cast<char*>(&t);
    const float *signal = of<float>(SIGNAL, b), *blurred = of<float>(INSTRUMENT, b), *weight = of<float>(WEIGHT, b);
    p.left = t.box[0][0] - t.centre[0];
    p.top = t.box[1][0] - t.centre[1];
    p.columns = t.columns;
    float* const w = reinterpret_cast<float*>(block + p.weight);
    for (int64_t i : chosen) w[p.weight_pitch ? at(p, i) : at(p, i) % p.pitch] = weight[i];
    round(p, chosen, {blurred, blurred + n, blurred + 3 * n}, p.z, block);
    round(p, chosen, {signal, signal + n, signal + 3 * n}, p.r, block);
    const auto project = [&](auto value) {  // Z W v
      std::vector<float> v(p.height * p.pitch), lines(MOST * p.pitch);
      for (int64_t i : chosen) v[at(p, i)] = value(i);
      Sums sums{};
      for (int64_t first = 0; first < p.height; first += BLOCK) {
        products(t, p, first, std::min(BLOCK, p.height - first), v.data() + first * p.pitch, lines.data());
        add_lines(t, p, lines.data(), sums);
      }
      return sums;
    };
    const auto contrast = [&](int64_t i) { return signal[3 * n + i] - p.r.level; };
    p.of_one = project([](int64_t) { return 1.f; });
    p.of_level = project(contrast);
    double square = 0;
    for (int64_t i : chosen) square += double(weight[i]) * contrast(i) * contrast(i);
    p.contrast = std::sqrt(std::max(square - p.of_level[4] * p.of_level[4] / p.of_one[4], 0.0));
    const auto column = [&](int64_t k, int64_t i) {
      const float x = float(p.left) + float(place(i, 0)), y = float(p.top) + float(place(i, 1));
      const float light[] = {x, y, x * x, y * y, x * y};
      return k < 3 ? signal[k * n + i] : k == 3 ? contrast(i) : k == 4 ? 1 : signal[3 * n + i] * light[k - 5];
    };
    for (int64_t k = 0; k < p.columns; ++k) {
      const Sums sums = project([&](int64_t i) { return column(k, i); });
      for (int64_t j = 0; j < p.columns; ++j) p.inverse[j][k] = sums[j];
    }
    invert(p.inverse, p.columns);
  }

  at::Tensor pack() const {
    int64_t bytes = (sizeof(Template) + 63) / 64 * 64;
    const Pixels whole = shape(all, true, bytes), thin = shape(some, false, bytes);
    const int64_t count = fields[K].size(0), n = fields[K].size(2);
    const at::Tensor packed = at::zeros({count, bytes}, at::kByte);
    at::parallel_for(0, count, 1, [&](int64_t first, int64_t last) {
      for (int64_t b = first; b < last; ++b) {
        Template& t = *reinterpret_cast<Template*>(packed.data_ptr<uint8_t>() + b * bytes);
        t.criterion = criterion;
        t.columns = fields[K].size(1);
        t.blocks = fields[BLOCK_SIZES].size(0);
        std::copy_n(fields[BOX].const_data_ptr<float>(), 8, t.box[0]);
        std::copy_n(of<float>(CENTRE, b), 2, t.centre);
        t.radius = *of<double>(RADIUS, b);
        t.noise = *of<float>(NOISE, b);
        t.noise_share = *of<double>(SHARE, b);
        std::copy_n(of<double>(ALIAS, b), 12, t.alias);
        std::copy_n(of<double>(SLOPE, b), 9, t.slope);
        std::copy_n(of<double>(SPREAD, b), 9, t.spread);
        std::copy_n(of<double>(INFLATION, b), 9, t.inflation);
        std::copy_n(of<double>(SPREAD_NOISE, b), 9, t.spread_noise);
        t.whole = whole;
        t.thin = thin;
        fill(t.whole, all, b, t);
        fill(t.thin, some, b, t);
        const float *k = of<float>(K, b), *weight = of<float>(WEIGHT, b), *level = of<float>(SIGNAL, b) + 3 * n;
        for (int64_t r = 0; r < 3; ++r) t.white[r] = std::inner_product(k + r * n, k + (r + 1) * n, k + r * n, 0.0);
        for (int64_t i = 0; i < n; ++i) {
          const double contrast = level[i] - t.whole.r.level;
          t.count += weight[i] > 0;
          t.w += weight[i];
          t.wt += weight[i] * contrast;
          t.wtt += weight[i] * contrast * contrast;
        }
      }
    });
    return packed;
  }
};

}  // namespace ecc
