// torch.ops.torch_ecc: align.solve and one step of the tracker for templates on the CPU, in parallel over them.
#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <torch/library.h>

#include <atomic>

#include "judge.h"
#include "pack.h"

namespace {

using at::Tensor;

ecc::Frame frame_of(const Tensor& image, int64_t b) {
  const auto kind = image.scalar_type();
  const int64_t offset = image.size(0) == 1 ? 0 : b * image.stride(0) * image.element_size();
  return {static_cast<const char*>(image.const_data_ptr()) + offset, image.size(2), image.size(3), image.stride(2),
          kind == at::kByte     ? ecc::Frame::U8
          : kind == at::kUInt16 ? ecc::Frame::U16
                                : ecc::Frame::F32};
}

struct Outcome {  // the fields of Estimate, and how many templates have a status: others wait for the torch path
  Tensor pose, displacement, score, status, iterations, covariance, residual;
  int64_t unsettled;

  std::vector<Tensor> fields() const { return {pose, displacement, score, status, iterations, covariance, residual}; }
};

// image (1 or B, 1, H, W) uint8, uint16 or float32, templates (B, bytes) of pack, poses to start from (B, 3) float64.
// Templates at the frame's border, where pixels drop out, are not settled: status -1.
Outcome align(const Tensor& image, const Tensor& templates, const Tensor& start, const ecc::Settings& set) {
  const Tensor rows = image.stride(3) == 1 ? image : image.contiguous(), poses = start.contiguous();
  const int64_t count = poses.size(0);
  const auto real = poses.options();
  Outcome out{at::empty({count, 3}, real), at::empty({count, 3}, real), at::empty({count}, real),
              at::empty({count}, real.dtype(at::kChar)), at::empty({count}, real.dtype(at::kLong)),
              at::empty({count, 3, 3}, real), at::empty({count}, real), 0};
  double *pose = out.pose.data_ptr<double>(), *moved = out.displacement.data_ptr<double>(),
         *score = out.score.data_ptr<double>(), *covariance = out.covariance.data_ptr<double>(),
         *residual = out.residual.data_ptr<double>();
  int8_t* status = out.status.data_ptr<int8_t>();
  int64_t* iterations = out.iterations.data_ptr<int64_t>();
  std::atomic<int64_t> next{0};  // each thread takes the next one: they are not equally much work
  at::parallel_for(0, std::min<int64_t>(count, at::get_num_threads()), 1, [&](int64_t, int64_t) {
    thread_local ecc::Scratch scratch;
    for (int64_t b = next++; b < count; b = next++) {
      const auto& t = *reinterpret_cast<const ecc::Template*>(templates.const_data_ptr<uint8_t>() + b * templates.size(1));
      const double* from = poses.const_data_ptr<double>() + 3 * b;
      ecc::State state{{from[0], from[1], from[2]}};
      ecc::Verdict verdict{};
      verdict.status = ecc::Status(-1);
      if (ecc::refine(t, frame_of(rows, b), set, state, scratch)) verdict = ecc::judge(t, set, state, scratch);
      const bool good = ecc::good(verdict.status);
      for (int k = 0; k < 3; ++k) {
        pose[3 * b + k] = good ? state.pose[k] : from[k];
        moved[3 * b + k] = pose[3 * b + k] - from[k];
      }
      for (int k = 0; k < 9; ++k) covariance[9 * b + k] = good ? verdict.covariance[k] : k % 4 ? 0 : HUGE_VAL;
      score[b] = verdict.score;
      status[b] = verdict.status;
      iterations[b] = state.iterations;
      residual[b] = std::sqrt(verdict.power);
    }
  });
  out.unsettled = std::count(status, status + count, int8_t(-1));
  return out;
}

Tensor pack(at::TensorList reference, int64_t criterion) { return ecc::Packer(reference, criterion).pack(); }

std::vector<Tensor> solve(const Tensor& image, const Tensor& templates, const Tensor& pose,
                          int64_t degree, int64_t max_iterations, double tolerance, double min_score) {
  return align(image, templates, pose, {degree, max_iterations, tolerance, min_score}).fields();
}

// One frame of Tracker: state = [pose, velocity, start, score, tracked, doubted] -> the fields of Estimate and the next
// state; the fields alone, as of solve, if some are to be searched for or are not settled.
std::vector<Tensor> track(const Tensor& image, const Tensor& templates, at::TensorList state, int64_t degree,
                          int64_t max_iterations, double tolerance, double min_score, bool hold, bool search) {
  const int64_t count = state[0].size(0);
  std::vector<Tensor> now, next;
  for (const Tensor& tensor : state) {
    now.push_back(tensor.contiguous());
    next.push_back(at::empty_like(now.back()));
  }
  const double *pose = now[0].const_data_ptr<double>(), *velocity = now[1].const_data_ptr<double>(),
               *start = now[2].const_data_ptr<double>(), *usual = now[3].const_data_ptr<double>();
  double *next_pose = next[0].data_ptr<double>(), *next_velocity = next[1].data_ptr<double>();
  next[2] = now[2];
  for (int64_t b = 0; b < count; ++b) ecc::compose(pose + 3 * b, velocity + 3 * b, next_pose + 3 * b);
  const Outcome out = align(image, templates, next[0], {degree, max_iterations, tolerance, min_score});
  const double* score = out.score.const_data_ptr<double>();
  const int8_t* status = out.status.const_data_ptr<int8_t>();
  const auto strange = [&](int64_t b) {  // Tracker._strange
    return !ecc::good(status[b]) || 1 - score[b] > ecc::WORSE * (1 - usual[b]) + ecc::SLACK;
  };
  bool all_familiar = true;
  for (int64_t b = 0; b < count; ++b) all_familiar = all_familiar && !strange(b);
  if (out.unsettled || (search && !all_familiar)) return out.fields();
  for (int64_t b = 0; b < count; ++b) {  // Tracker._advance
    const bool good = ecc::good(status[b]);
    double *found = out.pose.data_ptr<double>() + 3 * b, *moved = out.displacement.data_ptr<double>() + 3 * b;
    if (!good) std::copy(pose + 3 * b, pose + 3 * b + 3, found);
    for (int k = 0; k < 3; ++k) {
      next_pose[3 * b + k] = found[k];
      next_velocity[3 * b + k] = 0;
      moved[k] = found[k] - start[3 * b + k];
    }
    if (good && !hold && now[4].const_data_ptr<bool>()[b]) ecc::between(pose + 3 * b, found, next_velocity + 3 * b);
    next[3].data_ptr<double>()[b] = good ? usual[b] + ecc::MEMORY * (score[b] - usual[b]) : usual[b];
    next[4].data_ptr<bool>()[b] = good;
    next[5].data_ptr<int64_t>()[b] = strange(b) ? now[5].const_data_ptr<int64_t>()[b] + 1 : 0;
  }
  std::vector<Tensor> all = out.fields();
  all.insert(all.end(), next.begin(), next.end());
  return all;
}

}  // namespace

TORCH_LIBRARY(torch_ecc, m) {
  m.def("pack(Tensor[] reference, int criterion) -> Tensor");
  m.def(
      "solve(Tensor image, Tensor templates, Tensor pose, int degree, int max_iterations, float tolerance, "
      "float min_score) -> Tensor[]");
  m.def(
      "track(Tensor image, Tensor templates, Tensor[] state, int degree, int max_iterations, float tolerance, "
      "float min_score, bool hold, bool search) -> Tensor[]");
}

TORCH_LIBRARY_IMPL(torch_ecc, CPU, m) {
  m.impl("pack", &pack);
  m.impl("solve", &solve);
  m.impl("track", &track);
}

TORCH_LIBRARY_IMPL(torch_ecc, Autograd, m) {  // nothing here has a gradient: no time is spent on the question
  for (const char* name : {"pack", "solve", "track"}) m.impl(name, torch::CppFunction::makeFallthrough());
}
