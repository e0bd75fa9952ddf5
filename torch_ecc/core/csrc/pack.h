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
    for (int64_t& at : p.z) at = take(2 * p.pitch * p.height);
    if (whole) p.t = take(2 * p.pitch * p.height);
    return p;
  }

  // NaN, as of grey levels so large that their sums overflow, is as good as any: nothing is found with it.
  static int16_t nearest(float value) {
    return int16_t(std::nearbyint(std::max(-32767.f, std::min(32767.f, value))));
  }

  // Values (n,) of the chosen pixels less `level` as integers; returns their unit, which `most` is the most of.
  static float round(const Grid& chosen, const float* from, float level, float most, int16_t* to) {
    const float unit = std::max(most, 1e-30f) / 32767;
    for (int64_t i = 0; i < chosen.size(); ++i)
      to[chosen.at[i]] = nearest((from[i] - level) / unit);
    return unit;
  }

  static float most(const float* from, int64_t n, float level) {
    float largest = 0;
    for (int64_t i = 0; i < n; ++i) largest = std::max(largest, std::abs(from[i] - level));
    return largest;
  }

  static float mean(const float* from, int64_t n) { return float(std::accumulate(from, from + n, 0.0) / double(n)); }

  // The columns of criteria.py, R (5 + light, n), of the chosen pixels.
  std::vector<std::vector<float>> columns(const Pixels& p, const Grid& chosen, int64_t b, const Template& t) const {
    const int64_t n = chosen.size();
    std::vector<std::vector<float>> all(5 + t.light(), std::vector<float>(n, 1));
    for (int64_t i = 0; i < n; ++i) {
      const float* from = of<float>(SIGNAL, b) + chosen.pixel[i];
      const float x = float(p.left) + float(chosen.column[i]), y = float(p.top) + float(chosen.row[i]);
      const float grey = from[3 * fields[SIGNAL].size(2)], light[] = {x, y, x * x, y * y, x * y};
      for (int k = 0; k < 3; ++k) all[k][i] = from[k * fields[SIGNAL].size(2)];
      all[3][i] = grey - p.level;
      for (int k = 0; k < t.light(); ++k) all[5 + k][i] = grey * light[k];
    }
    return all;
  }

  void fill(Pixels& p, const Grid& chosen, int64_t b, Template& t) const {
    const int64_t n = chosen.size(), pixels = all.size();
    char* const block = reinterpret_cast<char*>(&t);
    const float* weight = of<float>(WEIGHT, b);
    p.left = t.box[0][0] - t.centre[0];
    p.top = t.box[1][0] - t.centre[1];
    p.columns = t.columns;
    p.level = mean(of<float>(SIGNAL, b) + 3 * pixels, pixels);
    float* const w = reinterpret_cast<float*>(block + p.weight);
    for (int64_t i = 0; i < n; ++i)
      w[p.weight_pitch ? chosen.at[i] : chosen.at[i] % p.pitch] = weight[chosen.pixel[i]];
    std::vector<float> z[3];  // d/dx, d/dy and t, blurred
    for (int k = 0; k < 3; ++k)
      for (int64_t i : chosen.pixel) z[k].push_back(of<float>(INSTRUMENT, b)[(k < 2 ? k : 3) * pixels + i]);
    p.soft_level = mean(z[2].data(), n);
    const float steepest = std::max(most(z[0].data(), n, 0), most(z[1].data(), n, 0));
    const auto images = [&](int64_t at) { return reinterpret_cast<int16_t*>(block + at); };
    float slope = 0;
    for (int k = 0; k < 2; ++k) slope = round(chosen, z[k].data(), 0, steepest, images(p.z[k]));
    p.soft = round(chosen, z[2].data(), p.soft_level, most(z[2].data(), n, p.soft_level), images(p.z[2]));
    const auto R = columns(p, chosen, b, t);
    p.grey = p.t == 0 ? 1 : round(chosen, R[3].data(), 0, most(R[3].data(), n, 0), images(p.t));
    const auto unit = [&](int64_t j) { return double(j < 3 ? slope : j == 4 ? 1 : p.soft); };  // of the column j of Z
    const int64_t line = lines_of(t) * p.pitch;
    std::vector<float> v(p.height * p.pitch), lines(R.size() * rows_of_blocks(p) * line);
    float* to = lines.data();
    for (size_t k = 0; k < R.size(); ++k) {
      for (int64_t i = 0; i < n; ++i) v[chosen.at[i]] = R[k][i];
      Sums sums;
      for (int64_t first = 0; first < p.height; first += BLOCK, to += line) {
        products<false>(t, p, first, std::min(BLOCK, p.height - first), v.data() + first * p.pitch, {}, to);
        add_lines(t, p, to, sums);
      }
      for (int64_t j = 0; j < p.columns; ++j) p.inverse[j][k] = sums.z[j] * unit(j);
      if (k == 3) p.of_level = sums.z;
      if (k == 4) p.of_one = sums.z;
    }
    const auto weighed = [&](size_t i, size_t j) {
      double sum = 0;
      for (int64_t k = 0; k < n; ++k) sum += double(weight[chosen.pixel[k]]) * R[i][k] * R[j][k];
      return sum;
    };
    p.contrast = std::sqrt(std::max(weighed(3, 3) - p.of_level[4] * p.of_level[4] / p.of_one[4], 0.0));
    invert(p.inverse, p.columns);  // in units of R on either side: what is singular does not depend on grey levels
    for (int64_t i = 0; i < p.columns; ++i)
      for (int64_t j = 0; j < p.columns; ++j) p.inverse[i][j] *= unit(j);
    if (p.t == 0) return;
    for (int k = 0; k < 3; ++k) std::copy_n(p.inverse[k], MOST, t.K[k]);
    for (size_t i = 0; i < R.size(); ++i)
      for (size_t j = 0; j <= i; ++j) t.gram[i][j] = t.gram[j][i] = weighed(i, j);
    parts(t, lines.data(), int64_t(R.size()));
  }

  // Sums of K's first rows times R over each block, from the lines (columns, rows of blocks, lines_of, pitch) of R.
  static void parts(Template& t, const float* lines, int64_t columns) {
    const Pixels& p = t.whole;
    const int64_t count = rows_of_blocks(p), each = 3 * columns * t.parts_pitch;
    std::vector<float> sums(count * each), line(3 * (p.pitch + BLOCK));
    const auto row = [&](int64_t r, int64_t k, int64_t c) { return r * each + (k * columns + c) * t.parts_pitch; };
    for (int64_t c = 0; c < columns; ++c)
      for (int64_t r = 0; r < count; ++r, lines += lines_of(t) * p.pitch) {
        float* const from = sums.data();
        blocks(t, lines, line.data(), {from + row(r, 0, c), from + row(r, 1, c), from + row(r, 2, c)});
      }
    int16_t* const to = reinterpret_cast<int16_t*>(reinterpret_cast<char*>(&t) + t.parts);
    for (int64_t c = 0; c < columns; ++c)
      for (int64_t k = 0; k < 3; ++k) {
        float largest = 0;
        for (int64_t r = 0; r < count; ++r) largest = std::max(largest, most(sums.data() + row(r, k, c), t.parts_pitch, 0));
        t.part[k][c] = std::max(largest, 1e-30f) / 32767;
        for (int64_t r = 0; r < count; ++r)
          for (int64_t i = row(r, k, c); i < row(r, k, c) + t.parts_pitch; ++i)
            to[i] = nearest(sums[i] / t.part[k][c]);
      }
  }

  at::Tensor pack() {
    int64_t bytes = (sizeof(Template) + 63) / 64 * 64;
    const Pixels whole = shape(all, true, bytes), thin = shape(some, false, bytes);
    const int64_t parts = bytes, parts_pitch = padded((whole.width + BLOCK - 1) / BLOCK);
    bytes += (6 * (5 + std::max<int64_t>(criterion, 0)) * parts_pitch * rows_of_blocks(whole) + 63) / 64 * 64;
    const int64_t count = fields[K].size(0), n = fields[K].size(2);
    const at::Tensor packed = at::zeros({count, bytes}, at::kByte);
    at::parallel_for(0, count, 1, [&](int64_t first, int64_t last) {
      for (int64_t b = first; b < last; ++b) {
        Template& t = *reinterpret_cast<Template*>(packed.data_ptr<uint8_t>() + b * bytes);
        t.criterion = criterion;
        t.columns = fields[K].size(1);
        t.blocks = fields[BLOCK_SIZES].size(0);
        t.thinned = some.size() < all.size();
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
        t.parts = parts;
        t.parts_pitch = parts_pitch;
        t.whole = whole;
        t.thin = thin;
        fill(t.whole, all, b, t);
        fill(t.thin, some, b, t);
        const float *k = of<float>(K, b), *weight = of<float>(WEIGHT, b);
        for (int64_t r = 0; r < 3; ++r) t.white[r] = std::inner_product(k + r * n, k + (r + 1) * n, k + r * n, 0.0);
        t.count = std::count_if(weight, weight + n, [](float w) { return w > 0; });
      }
    });
    return packed;
  }
};

}  // namespace ecc
