// A few threads that work on one thing together. The kernels see only this, not OpenMP.
#pragma once

#include <atomic>
#include <cstdint>

namespace pd {

// Spins for some microseconds, then sleeps: on a busy machine a thread that keeps spinning would keep the one that it waits
// for from running.
class Barrier {
 public:
  void wait(int size) {
    const std::uint32_t phase = phase_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == size) {
      arrived_.store(0, std::memory_order_relaxed);
      phase_.fetch_add(1, std::memory_order_acq_rel);
      phase_.notify_all();
      return;
    }
    for (int spin = 0; spin < 4000; ++spin) {
      if (phase_.load(std::memory_order_acquire) != phase) return;
      pause();
    }
    while (phase_.load(std::memory_order_acquire) == phase)
      phase_.wait(phase, std::memory_order_acquire);
  }

 private:
  static void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("yield");
#endif
  }

  std::atomic<int> arrived_{0};
  std::atomic<std::uint32_t> phase_{0};
};

struct Team {
  int rank = 0, size = 1;
  Barrier* shared = nullptr;  // null for a team of one

  void barrier() const {
    if (shared) shared->wait(size);
  }
  // first item of this member's share of `count`, and of the next member's
  std::int64_t begin(std::int64_t count) const { return count * rank / size; }
  std::int64_t end(std::int64_t count) const { return count * (rank + 1) / size; }
};

// How many threads this process may use at most.
int most_threads();

// Calls work(context, team) in every thread of a new team of at most `threads`; alone inside another parallel region.
void run_team(int threads, void (*work)(void* context, const Team& team), void* context);

template <class Work>
void run_team(int threads, Work work) {
  run_team(
      threads, [](void* context, const Team& team) { (*static_cast<Work*>(context))(team); },
      &work);
}

}  // namespace pd
