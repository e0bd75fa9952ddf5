// torch.ops.torch_ecc.solve: the loop of core/solver.py for templates on the CPU, in parallel over them.
#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/nonzero.h>
#include <torch/library.h>

#include <algorithm>
#include <atomic>
#include <optional>

#include "solve.h"

namespace {

using at::Tensor;

template <class... Words>
void require(bool right, const Words&... words) {
  TORCH_CHECK_VALUE(right, "torch_ecc.solve: ", words...);
}

void require(const Tensor& tensor, const char* name, at::ScalarType kind, std::initializer_list<int64_t> sizes) {
  require(tensor.device().is_cpu() && tensor.scalar_type() == kind && tensor.is_contiguous() && tensor.sizes() == at::IntArrayRef(sizes),
          name, " must be ", kind, " ", at::IntArrayRef(sizes), ", contiguous, on the CPU; got ", tensor.scalar_type(), " ", tensor.sizes());
}

struct Planes {  // packed.Packed: one grid of all templates
  Tensor planes, weight, numbers;
  int64_t width, step;

  Planes(at::TensorList tensors, int64_t width, int64_t step, int64_t count)
      : planes(tensors[0]), weight(tensors[1]), numbers(tensors[2]), width(width), step(step) {
    require(planes.dim() == 4, "planes must be (B, ", int(ecc::PLANES), ", h, pitch), got ", planes.sizes());
    const int64_t h = planes.size(2), pitch = planes.size(3);
    require(planes, "planes", at::kShort, {count, ecc::PLANES, h, pitch});
    require(h > 0 && width > 0 && width <= pitch && pitch % ecc::LANES == 0 && step > 0 && step <= 64,
            "planes must have rows, width be 1 to their pitch, a multiple of ", ecc::LANES, ", and step 1 to 64");
    require(numbers, "numbers", at::kDouble, {count, sizeof(ecc::Numbers) / sizeof(double)});
    if (weight.dim() == 3 && weight.size(0) == 1 && weight.size(1) == 1)
      require(weight, "weight", at::kFloat, {1, 1, pitch});
    else
      require(weight, "weight", at::kFloat, {count, h, pitch});
  }

  ecc::Pixels of(int64_t b, const float* trust, int64_t across) const {
    const int64_t h = planes.size(2), pitch = planes.size(3);
    const bool even = weight.size(0) == 1 && weight.size(1) == 1;  // one row serves for all
    return {planes.const_data_ptr<int16_t>() + b * ecc::PLANES * h * pitch,
            reinterpret_cast<const ecc::Numbers*>(numbers.const_data_ptr<double>()) + b,
            {weight.const_data_ptr<float>() + (even ? 0 : b * h * pitch), even ? 0 : pitch}, width, h, pitch, double(step),
            trust, across};
  }
};

ecc::Frame frame_of(const Tensor& image, int64_t b) {
  const auto kind = image.scalar_type();
  const int64_t offset = image.size(0) == 1 ? 0 : b * image.stride(0) * image.element_size();
  return {static_cast<const char*>(image.const_data_ptr()) + offset, image.size(2), image.size(3), image.stride(2),
          kind == at::kByte     ? ecc::Frame::U8
          : kind == at::kUInt16 ? ecc::Frame::U16
                                : ecc::Frame::F32};
}

// See core/native.py. Pose, error, iterations, gain, sums and total of solution.Solution; and of the templates of which
// not all pixels counted their index (n,) and moments (n, ...). With trust of the templates at index, of these alone.
std::vector<Tensor> solve(const Tensor& image, const Tensor& start, at::TensorList grids, at::IntArrayRef widths,
                          at::IntArrayRef steps, int64_t criterion, int64_t degree, int64_t max_iterations,
                          double tolerance, const std::optional<Tensor>& trust, const std::optional<Tensor>& index) {
  const int64_t templates = start.dim() ? start.size(0) : 0;
  const auto kind = image.scalar_type();
  require(start.device().is_cpu() && start.scalar_type() == at::kDouble && start.sizes() == at::IntArrayRef({templates, 3}),
          "pose must be float64 (B, 3) on the CPU, got ", start.scalar_type(), " ", start.sizes());
  require(image.device().is_cpu() && (kind == at::kByte || kind == at::kUInt16 || kind == at::kFloat) && image.dim() == 4 &&
              (image.size(0) == 1 || image.size(0) == templates) && image.size(1) == 1 && image.numel() > 0,
          "image must be uint8, uint16 or float32, (1 or ", templates, ", 1, H, W) on the CPU, got ", kind, " ", image.sizes());
  require(criterion == ecc::PAPER || criterion == ecc::SSD || criterion == 0 || criterion == 2 || criterion == 5,
          "criterion must be -2, -1, 0, 2 or 5, got ", criterion);
  require(degree == 1 || degree == 3 || degree == 5, "degree must be 1, 3 or 5, got ", degree);
  require(max_iterations >= 1, "max_iterations must be at least 1, got ", max_iterations);
  require(tolerance > 0 && std::isfinite(tolerance), "tolerance must be a length in px > 0, got ", tolerance);
  const size_t n = grids.size() / 3;
  require(grids.size() == 3 * n && (n == 1 || n == 2) && widths.size() == n && steps.size() == n,
          "expected planes, weight, numbers, width and step of one or two grids");
  const Planes all(grids.slice(0, 3), widths[0], steps[0], templates);
  const Planes coarse(grids.slice(3 * (n - 1), 3), widths[n - 1], steps[n - 1], templates);
  require(coarse.planes.size(2) <= all.planes.size(2) && coarse.planes.size(3) <= all.planes.size(3),
          "the second grid must not be larger than the first");
  const Tensor rows = image.stride(3) == 1 ? image : image.contiguous(), from = start.contiguous();
  const ecc::Settings settings{degree, max_iterations, tolerance};
  const auto blocks = [](int64_t n) { return (n + ecc::BLOCK - 1) / ecc::BLOCK; };
  const int64_t across = blocks(widths[0]), each = blocks(all.planes.size(2)) * across;
  require(bool(trust) == bool(index), "trust and index come together");
  require(steps[0] == 1 || !trust, "trust needs the first grid to have all pixels");
  require((coarse.planes.size(2) - 1) * steps[n - 1] < all.planes.size(2) && (widths[n - 1] - 1) * steps[n - 1] < widths[0],
          "the second grid must not reach beyond the first");
  const int64_t count = index ? index->numel() : templates;
  if (trust) {
    require(*index, "index", at::kLong, {count});
    require(*trust, "trust", at::kFloat, {count, each});
    const int64_t* const first = index->const_data_ptr<int64_t>();
    require(std::all_of(first, first + count, [&](int64_t b) { return b >= 0 && b < templates; }), "index must be 0 to ",
            templates - 1);
  }
  const auto real = from.options();
  const Tensor pose = at::empty({count, 3}, real), error = at::empty({count}, real),
               iterations = at::empty({count}, real.dtype(at::kLong)), gain = at::empty({count}, real),
               sums = at::empty({count, ecc::SUMS, each}, real.dtype(at::kFloat)),
               total = at::empty({count, ecc::SUMS + 3}, real);
  const Tensor moments = at::empty({count, sizeof(ecc::Moments) / sizeof(double)}, real);
  const Tensor partial = at::empty({count}, real.dtype(at::kBool));
  std::atomic<int64_t> next{0};  // each thread takes the next one: they are not equally much work
  at::parallel_for(0, std::min<int64_t>(count, at::get_num_threads()), 1, [&](int64_t, int64_t) {
    thread_local ecc::Scratch scratch;
    for (int64_t b = next++; b < count; b = next++) {
      const int64_t which = index ? index->const_data_ptr<int64_t>()[b] : b;
      const float* const trusted = trust ? trust->const_data_ptr<float>() + b * each : nullptr;
      const ecc::Template t{criterion, criterion < 0 ? 3 : 5 + criterion, n == 2, all.of(which, trusted, across),
                            coarse.of(which, trusted, across)};
      const double* at = from.const_data_ptr<double>() + 3 * which;
      ecc::State state{{at[0], at[1], at[2]}};
      float* const out = sums.data_ptr<float>() + b * ecc::SUMS * each;
      const bool seen = ecc::solve(t, frame_of(rows, which), settings, state, scratch);
      double* const of_all = total.data_ptr<double>() + b * (ecc::SUMS + 3);
      if (seen) {
        if (scratch.partial) ecc::complete(t, t.whole, scratch.border);
        ecc::summed(t, t.whole, scratch.seen(t.whole), scratch.weighted(t.whole), scratch.patch.data(), scratch.model,
                    scratch.lines.data(), out, of_all);
      } else {
        scratch.border.moments = {};
        std::fill_n(out, ecc::SUMS * each, 0.f);
        std::fill_n(of_all, ecc::SUMS + 3, 0.0);
      }
      if (scratch.partial)
        std::memcpy(moments.data_ptr<double>() + b * moments.size(1), &scratch.border.moments, sizeof(ecc::Moments));
      partial.data_ptr<bool>()[b] = scratch.partial;
      std::copy_n(state.pose, 3, pose.data_ptr<double>() + 3 * b);
      error.data_ptr<double>()[b] = state.error;
      iterations.data_ptr<int64_t>()[b] = state.iterations;
      gain.data_ptr<double>()[b] = seen ? ecc::finite(scratch.model.fit[3]) : 0;
    }
  });
  const bool* const first = partial.const_data_ptr<bool>();
  if (std::none_of(first, first + count, [](bool each) { return each; }))
    return {pose, error, iterations, gain, sums, total, at::empty({0}, real.dtype(at::kLong)), moments};
  const Tensor anew = at::nonzero(partial).select(1, 0);
  return {pose, error, iterations, gain, sums, total, anew, moments.index_select(0, anew)};
}

}  // namespace

TORCH_LIBRARY(torch_ecc, m) {
  m.def(
      "solve(Tensor image, Tensor pose, Tensor[] grids, int[] widths, int[] steps, int criterion, "
      "int degree, int max_iterations, float tolerance, Tensor? trust=None, Tensor? index=None) -> Tensor[]");
}

TORCH_LIBRARY_IMPL(torch_ecc, CPU, m) { m.impl("solve", &solve); }

TORCH_LIBRARY_IMPL(torch_ecc, Autograd, m) {  // nothing here has a gradient: no time is spent on the question
  m.impl("solve", torch::CppFunction::makeFallthrough());
}
