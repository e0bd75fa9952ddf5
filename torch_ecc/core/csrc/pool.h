// Threads that sleep until there is work. The caller works too and waits for none that has not begun: where something
// else keeps a core busy, it does all by itself.
#pragma once
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <exception>
#include <functional>
#include <mutex>
#include <system_error>
#include <thread>
#ifndef _WIN32
#include <pthread.h>
#endif

namespace ecc {

struct Job {  // tasks 0 to count - 1; each thread takes the next one: they are not equally much work
  int64_t count;
  const std::function<void(int64_t)>& task;
  std::atomic<int64_t> next{0};
  std::atomic<bool> failed{false};
  int64_t wanted = 0, working = 0;  // threads that may still come, and that are at it

  void work() {
    try {
      for (int64_t k = next++; k < count; k = next++) task(k);
    } catch (const std::exception&) {  // there is not enough memory: nobody need go on
      failed = true;
      next = count;
    }
  }
};

struct Pool {
  std::mutex mutex;
  std::condition_variable wake, done;
  std::deque<Job*> jobs;
  int64_t threads = 0;

  void run(Job& job, int64_t helpers) {
    {
      std::lock_guard lock(mutex);
      try {
        for (; threads < helpers; ++threads) std::thread([this] { serve(); }).detach();
      } catch (const std::system_error&) {  // there are no more of them
        helpers = threads;
      }
      job.wanted = helpers;
      if (helpers) jobs.push_back(&job);
    }
    for (int64_t k = 0; k < helpers; ++k) wake.notify_one();
    job.work();
    std::unique_lock lock(mutex);
    if (job.wanted) jobs.erase(std::find(jobs.begin(), jobs.end(), &job));
    done.wait(lock, [&] { return job.working == 0; });
  }

  void serve() {
    for (std::unique_lock lock(mutex);;) {
      wake.wait(lock, [&] { return !jobs.empty(); });
      Job& job = *jobs.front();
      if (--job.wanted == 0) jobs.pop_front();
      ++job.working;
      lock.unlock();
      job.work();
      lock.lock();
      if (--job.working == 0) done.notify_all();
    }
  }
};

// The threads end with the process. A forked one has none of them: it begins with a pool of its own.
inline Pool*& pool() {
  static Pool* pool = [] {
#ifndef _WIN32
    pthread_atfork(nullptr, nullptr, [] { ecc::pool() = new Pool; });
#endif
    return new Pool;
  }();
  return pool;
}

// task(0) to task(count - 1) on as many threads, this one among them. False if one of them has failed.
inline bool share(int64_t count, int64_t threads, const std::function<void(int64_t)>& task) {
  Job job{count, task};
  const int64_t helpers = std::min(count, threads) - 1;
  if (helpers > 0)
    pool()->run(job, helpers);
  else
    job.work();
  return !job.failed;
}

}  // namespace ecc
