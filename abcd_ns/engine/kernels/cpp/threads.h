// Threads that sleep while they have nothing to do.
#pragma once
#include <pthread.h>

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>

class Pool {
 public:
  // Calls job(0) ... job(count - 1), each once, in any order, on up to `threads` threads. A helper that wakes
  // too late is not waited for: on a busy machine the caller does the work itself.
  void run(int threads, int64_t count, const std::function<void(int64_t)>& job) {
    std::unique_lock<std::mutex> mine(callers_, std::try_to_lock);
    if (threads < 2 || count < 2 || !mine.owns_lock()) {
      for (int64_t k = 0; k < count; k++) job(k);
      return;
    }
    const int helpers = int(std::min<int64_t>(threads, count)) - 1;
    {
      std::lock_guard<std::mutex> lock(state_);
      for (; started_ < helpers; started_++) std::thread([this] { help(); }).detach();
      job_ = &job, count_ = count, next_ = 0, places_ = helpers;
    }
    for (int k = 0; k < helpers; k++) wake_.notify_one();
    for (int64_t k; (k = next_++) < count;) job(k);
    std::unique_lock<std::mutex> lock(state_);
    places_ = 0;  // nobody joins any more
    done_.wait(lock, [this] { return busy_ == 0; });
  }

 private:
  void help() {
    std::unique_lock<std::mutex> lock(state_);
    for (;;) {
      wake_.wait(lock, [this] { return places_ > 0; });
      places_--, busy_++;
      const auto* job = job_;
      const int64_t count = count_;
      lock.unlock();
      for (int64_t k; (k = next_++) < count;) (*job)(k);
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  std::mutex callers_, state_;
  std::condition_variable wake_, done_;
  const std::function<void(int64_t)>* job_ = nullptr;
  std::atomic<int64_t> next_{0};
  int64_t count_ = 0;
  int started_ = 0, places_ = 0, busy_ = 0;
};

// Never deleted: its threads sleep until the process ends. A forked child has none of them, and begins anew.
static Pool* pool = [] {
  pthread_atfork(nullptr, nullptr, [] { pool = new Pool; });
  return new Pool;
}();
static std::atomic<int> threads_in_use{1};

template <class Job>
static inline void parallel(int64_t count, const Job& job) {
  pool->run(threads_in_use, count, job);
}

// Jobs over [0, n) in parts of `size`: job(first, last).
template <class Job>
static inline void parallel_ranges(int64_t n, int64_t size, const Job& job) {
  parallel((n + size - 1) / size, [&](int64_t k) { job(k * size, std::min(n, (k + 1) * size)); });
}
