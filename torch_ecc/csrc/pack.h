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

// criteria.safe_inverse by Gauss-Jordan, with rows and columns brought to unit diagonal; zero if singular to float32.
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
  double size = 0;
  bool regular = true;
  for (int64_t i = 0; i < n; ++i) {
    regular = regular && matrix[i][i] > 0;
    for (int64_t j = 0; j < n; ++j) size += std::abs(wide[i][n + j]);
  }
  regular = regular && size < 1e6;  // NaN and infinity compare as singular
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) matrix[i][j] = regular ? wide[i][n + j] * scale[i] * scale[j] : 0;
}

struct Grid {  // chosen pixels of a template: numbers, and columns and rows in its bounding box
  std::vector<int64_t> pixel, column, row, at;  // at: in the rows of Pixels
  int64_t size() const { return int64_t(pixel.size()); }
};

struct Packer {
  std::vector<at::Tensor> fields;
  int64_t criterion;
  Grid all, some;  // of the whole and of the thin template

  Packer(at::TensorList reference, int64_t criterion) : criterion(criterion) {
    for (const at::Tensor& tensor : reference) fields.push_back(tensor.contiguous());
    const int64_t n = fields[PIXELS].size(1);
    all.pixel.resize(n);
    std::iota(all.pixel.begin(), all.pixel.end(), 0);
    const int64_t* sparse = fields[SPARSE].const_data_ptr<int64_t>();
    some.pixel.assign(sparse, sparse + fields[SPARSE].size(0));
    const float *pixels = fields[PIXELS].const_data_ptr<float>(), *box = fields[BOX].const_data_ptr<float>();
    for (Grid* grid : {&all, &some})
      for (int64_t i : grid->pixel) {
        grid->column.push_back(std::lround(pixels[i] - box[0]));
        grid->row.push_back(std::lround(pixels[n + i] - box[4]));
      }
  }

  template <class T>
  const T* of(Field field, int64_t b) const {
    const at::Tensor& tensor = fields[field];
    return tensor.const_data_ptr<T>() + (tensor.size(0) == 1 ? 0 : b) * (tensor.numel() / tensor.size(0));
  }

  // Shape of the grid of chosen pixels, and where its arrays lie behind `end`, which moves on.
  Pixels shape(Grid& chosen, bool whole, int64_t& end) const {
    Pixels p{};
    int64_t step = 0;
    for (int64_t i = 0; i < chosen.size(); ++i) {
      step = std::gcd(std::gcd(step, chosen.column[i]), chosen.row[i]);
      p.width = std::max(p.width, chosen.column[i] + 1);
      p.height = std::max(p.height, chosen.row[i] + 1);
    }
    step = whole ? 1 : std::max<int64_t>(step, 1);  // the whole of a mask with gaps counts in px, gaps and all
    p.width = (p.width + step - 1) / step;
    p.height = (p.height + step - 1) / step;
    p.step = double(step);
    p.pitch = padded(p.width);
    for (int64_t i = 0; i < chosen.size(); ++i)
      chosen.at.push_back(chosen.row[i] / step * p.pitch + chosen.column[i] / step);
    const bool even = chosen.size() == p.width * p.height && fields[WEIGHT].eq(1).all().item<bool>();
    p.weight_pitch = even ? 0 : p.pitch;  // one row serves if all are alike
    const auto take = [&](int64_t bytes) { return std::exchange(end, (end + bytes + 63) / 64 * 64); };
    p.weight = take(4 * p.pitch * (even ? 1 : p.height));
    for (int64_t& at : p.z.at) at = take(2 * p.pitch * p.height);
    for (int64_t& at : p.r.at) at = whole ? take(2 * p.pitch * p.height) : 0;
    return p;
  }

  // Values (3, n) of the chosen pixels, the first two in one unit and the third less its mean, as integers.
  void round(const Grid& chosen, const float* const (&from)[3], Images& images, char* block) const {
    const int64_t n = chosen.size();
    images.level = float(std::accumulate(from[2], from[2] + n, 0.0) / double(n));
    float most[3] = {1e-30f, 1e-30f, 1e-30f};
    const auto level = [&](int k) { return k == 2 ? images.level : 0.f; };
    for (int k = 0; k < 3; ++k)
      for (int64_t i = 0; i < n; ++i) most[k] = std::max(most[k], std::abs(from[k][i] - level(k)));
    images.gradient = std::max(most[0], most[1]) / 32767;
    images.grey = most[2] / 32767;
    for (int k = 0; k < 3 && images.at[k] > 0; ++k) {
      int16_t* const to = reinterpret_cast<int16_t*>(block + images.at[k]);
      const float unit = k == 2 ? images.grey : images.gradient;
      for (int64_t i = 0; i < n; ++i)
        to[chosen.at[i]] = int16_t(std::nearbyint(std::clamp((from[k][i] - level(k)) / unit, -32767.f, 32767.f)));
    }
  }

  void fill(Pixels& p, const Grid& chosen, int64_t b, Template& t) const {
    const int64_t n = chosen.size(), all_pixels = all.size();
    char* const block = reinterpret_cast<char*>(&t);
    std::vector<float> lines(8 * n);  // d/dx, d/dy, d/dtheta and t, raw and blurred
    float* row[8];
    for (int k = 0; k < 8; ++k) {
      const float* from = of<float>(k < 4 ? SIGNAL : INSTRUMENT, b) + k % 4 * all_pixels;
      row[k] = lines.data() + k * n;
      for (int64_t i = 0; i < n; ++i) row[k][i] = from[chosen.pixel[i]];
    }
    const float* weight = of<float>(WEIGHT, b);
    p.left = t.box[0][0] - t.centre[0];
    p.top = t.box[1][0] - t.centre[1];
    p.columns = t.columns;
    float* const w = reinterpret_cast<float*>(block + p.weight);
    for (int64_t i = 0; i < n; ++i)
      w[p.weight_pitch ? chosen.at[i] : chosen.at[i] % p.pitch] = weight[chosen.pixel[i]];
    round(chosen, {row[4], row[5], row[7]}, p.z, block);
    round(chosen, {row[0], row[1], row[3]}, p.r, block);
    std::vector<float> v(p.height * p.pitch), sum(MOST * p.pitch);
    const auto project = [&](auto value) {  // Z W v
      for (int64_t i = 0; i < n; ++i) v[chosen.at[i]] = value(i);
      Sums sums{};
      for (int64_t first = 0; first < p.height; first += BLOCK) {
        products(t, p, first, std::min(BLOCK, p.height - first), v.data() + first * p.pitch, sum.data());
        add_lines(t, p, sum.data(), sums);
      }
      return sums;
    };
    const auto contrast = [&](int64_t i) { return row[3][i] - p.r.level; };
    p.of_one = project([](int64_t) { return 1.f; });
    p.of_level = project(contrast);
    double square = 0;
    for (int64_t i = 0; i < n; ++i) square += double(weight[chosen.pixel[i]]) * contrast(i) * contrast(i);
    p.contrast = std::sqrt(std::max(square - p.of_level[4] * p.of_level[4] / p.of_one[4], 0.0));
    const auto light = [&](int64_t k, int64_t i) {
      const float x = float(p.left) + float(chosen.column[i]), y = float(p.top) + float(chosen.row[i]);
      return k == 0 ? x : k == 1 ? y : k == 2 ? x * x : k == 3 ? y * y : x * y;
    };
    for (int64_t k = 0; k < p.columns; ++k) {
      const Sums sums = k == 3   ? p.of_level
                        : k == 4 ? p.of_one
                        : k < 3  ? project([&](int64_t i) { return row[k][i]; })
                                 : project([&](int64_t i) { return row[3][i] * light(k - 5, i); });
      for (int64_t j = 0; j < p.columns; ++j) p.inverse[j][k] = sums[j];
    }
    invert(p.inverse, p.columns);
  }

  at::Tensor pack() {
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
