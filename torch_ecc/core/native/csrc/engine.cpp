// The entries: torch_ecc_solve, the loop of core/solver.py for templates on the CPU, in parallel over them, and what
// leads back from poses to the image. All that is pointed to has been checked by their only callers, in Python.
#include "adjoint.h"
#include "pool.h"
#include "solve.h"

#ifdef _WIN32
#define EXPORTED extern "C" __declspec(dllexport)
#else
#define EXPORTED extern "C" __attribute__((visibility("default")))
#endif

namespace ecc {

static_assert(sizeof(void*) == 8);  // in records that Python makes

struct Grid {  // packed.GRID, of all templates
  const int16_t* planes;
  const float* weight;
  const Numbers* numbers;
  int64_t height, pitch, width, step, even, alike;  // even: one row of weights serves for all; alike: one template does

  Pixels of(int64_t which, const float* trust, int64_t across) const {
    const int64_t b = alike ? 0 : which;
    const Weights weights{even ? weight : weight + b * height * pitch, even ? 0 : pitch};
    return {planes + b * PLANES * height * pitch, numbers + b, weights, width, height, pitch, double(step), trust, across};
  }
};

struct Call {  // entry.CALL
  Frame frame;
  int64_t next_frame;    // from one template's frame to the next, in pixels
  const double* start;   // (B, 3)
  const int64_t* index;  // (count,) of the templates that trust is about, or null
  const float* trust;    // (count, blocks), or null
  const double* distortion;  // (B, 2, 2), or null
  double *pose, *error;  // (count, 3), (count,); and so on, see solution.Solution
  int64_t* iterations;
  double* gain;
  float* sums;
  double* total;
  Moments* moments;  // their first number is -1 if all pixels counted
  int64_t count, threads;
  Settings settings;
  int64_t criterion, coarser;
  Grid whole, coarse;
};

// Template b of them. Whether all of its pixels counted.
bool answer(const Call& call, int64_t b) {
  thread_local Scratch scratch;
  const int64_t which = call.index ? call.index[b] : b;
  const int64_t across = blocks(call.whole.width), each = across * blocks(call.whole.height);
  const float* const trust = call.trust ? call.trust + b * each : nullptr;
  const Template t{call.criterion, call.criterion < 0 ? 3 : 5 + call.criterion, bool(call.coarser),
                   call.whole.of(which, trust, across), call.coarse.of(which, trust, across)};
  const double* const at = call.start + 3 * which;
  State state{{at[0], at[1], at[2]}, {0, 0, 0, 0}};
  if (call.distortion) std::copy_n(call.distortion + 4 * which, 4, state.distortion);
  float* const sums = call.sums + b * SUMS * each;
  double* const total = call.total + b * (SUMS + CLUSTERS);
  const bool seen = solve(t, call.frame.after(which * call.next_frame), call.settings, state, scratch);
  if (seen) {
    if (scratch.partial) complete(t, t.whole, scratch.border);
    summed(t, t.whole, scratch.seen(t.whole), scratch.weighted(t.whole), scratch.patch.data(), scratch.model,
           scratch.lines.data(), sums, total);
  } else {
    scratch.border.moments = {};
    std::fill_n(sums, SUMS * each, 0.f);
    std::fill_n(total, SUMS + CLUSTERS, 0.0);
  }
  std::copy_n(state.pose, 3, call.pose + 3 * b);
  call.error[b] = state.error;
  call.iterations[b] = state.iterations;
  call.gain[b] = seen ? finite(scratch.model.fit[3]) : 0;
  call.moments[b] = scratch.partial ? scratch.border.moments : Moments{-1};
  return !scratch.partial;
}

}  // namespace ecc

// What a C++ runtime that is linked in would bring, half as much again as all else, to name an exception in words that
// nobody would read: none leaves this library.
extern "C" char* __cxa_demangle(const char*, char*, std::size_t*, int*) { return nullptr; }

// The number of templates of which not all pixels counted; -1 if memory does not suffice.
EXPORTED int64_t torch_ecc_solve(const ecc::Call* call) {
  std::atomic<int64_t> partial{0};
  const bool done = ecc::share(call->count, call->threads, [&](int64_t b) {
    if (!ecc::answer(*call, b)) ++partial;
  });
  return done ? partial.load() : -1;
}

// The values of patches and their slopes; -1 if memory does not suffice.
EXPORTED int64_t torch_ecc_linearise(const ecc::View* view) {
  const auto go = view->degree == 1 ? ecc::linearise<1> : view->degree == 3 ? ecc::linearise<3> : ecc::linearise<5>;
  return ecc::share(view->count, view->threads, [&](int64_t b) { go(*view, b); }) - 1;
}

// From gradients by these values to one by the image, which more than one thread may only add to if each patch has its own.
EXPORTED int64_t torch_ecc_spread(const ecc::View* view) {
  const auto go = view->degree == 1 ? ecc::spread<1> : view->degree == 3 ? ecc::spread<3> : ecc::spread<5>;
  return ecc::share(view->count, view->threads, [&](int64_t b) { go(*view, b); }) - 1;
}
