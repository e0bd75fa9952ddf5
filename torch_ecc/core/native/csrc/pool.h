// Threads that sleep until there is work. The caller works too and waits for none that has not begun: where something
// else keeps a core busy, it does all by itself.
#pragma once
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
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
  Job* job = nullptr;                            // the one that is shared: who comes meanwhile works alone
  int64_t threads = 0, wanted = 0, working = 0;  // all there are; those that may still come to it, and are at it

  void share(Job& shared, int64_t helpers) {
    std::unique_lock lock(mutex);
    const bool alone = job;
    if (!alone) {
      try {
        for (; threads < helpers; ++threads) std::thread([this] { serve(); }).detach();
      } catch (const std::system_error&) {  // there can be no more of them
      }
      job = &shared;
      wanted = std::min(helpers, threads);
    }
    lock.unlock();
    for (int64_t k = 0; !alone && k < helpers; ++k) wake.notify_one();
    shared.work();
    if (alone) return;
    lock.lock();
    wanted = 0;
    done.wait(lock, [&] { return working == 0; });
    job = nullptr;
  }

  void serve() {
    for (std::unique_lock lock(mutex);;) {
      wake.wait(lock, [&] { return wanted > 0; });
      --wanted;
      ++working;
      lock.unlock();
      job->work();
      lock.lock();
      if (--working == 0) done.notify_one();
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
  if (threads > 1 && count > 1)
    pool()->share(job, std::min(count, threads) - 1);
  else
    job.work();
  return !job.failed;
}

}  // namespace ecc
