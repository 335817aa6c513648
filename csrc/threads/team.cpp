#include "threads/team.h"

#if defined(_OPENMP)
#include <omp.h>
#endif
#include <pthread.h>

#include <algorithm>
#include <condition_variable>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace pd {
namespace {

std::atomic<Interrupt::Check> the_check{nullptr};

struct Job {
  void (*work)(void* context, const Team& team);
  void* context;
  int size = 1;
  Interrupt interrupt{};
  Barrier barrier{interrupt};
  std::mutex failing{};
  std::exception_ptr failure{};

  // An exception, such as a failed allocation, must not leave a thread.
  void run(int rank) {
    try {
      work(context, {rank, size, size > 1 ? &barrier : nullptr, &interrupt, rank == 0});
    } catch (const Dismissed&) {
    } catch (...) {
      const std::lock_guard lock(failing);
      failure = std::current_exception();
    }
  }
  void conclude() const {
    if (failure) std::rethrow_exception(failure);
    interrupt.conclude();
  }
};

// Number of forks up to this process. A forked child has only one of its parent's threads.
std::atomic<int> forks{0};
const int registered = pthread_atfork(nullptr, nullptr, [] { ++forks; });

// The worker threads of one calling thread. OpenMP's poll for milliseconds after their work, and a team waits for
// every member. On a busy machine the first wastes time that the next work needs. The second takes a time slice of
// another process at every barrier.
class Workers {
 public:
  Workers() = default;
  Workers(const Workers&) = delete;
  ~Workers() {
    {
      const std::lock_guard lock(joining_);
      leaving_ = true;
    }
    wake();
    for (std::thread& thread : threads_) thread.join();
  }

  bool are_of_this_process() const { return forks_ == forks; }

  // Runs the job by the workers that start in time; alone for a while after a slow team.
  void run(Job& job, int wanted) {
    auto now = Barrier::Clock::now();
    if (now >= again_) now = gather(job, wanted);
    job.barrier.begin(now);
    job.run(0);
    if (job.size > 1) finish(job);
    if (job.barrier.slow()) pause(Barrier::Clock::now());
  }

 private:
  // Wakes at most `wanted` workers; returns the time when those in time have started.
  Barrier::Clock::time_point gather(Job& job, int wanted) {
    make(wanted);
    wanted = std::min(wanted, int(threads_.size()));
    {
      const std::lock_guard lock(joining_);
      job_ = &job;
      openings_ = wanted;
      joined_.store(0, std::memory_order_relaxed);
    }
    wake();
    const auto all_arrived = [&] { return joined_.load(std::memory_order_acquire) == wanted; };
    auto now = Barrier::Clock::now();
    const auto latest = now + team_timeout;
    const auto poll = [&] {
      std::this_thread::yield();
      now = Barrier::Clock::now();
    };
    wait_until([&] { return all_arrived() || now >= latest; }, poll);
    if (!all_arrived()) pause(now);
    {
      const std::lock_guard lock(joining_);
      openings_ = 0;
      job.size = 1 + joined_.load(std::memory_order_relaxed);
    }
    left_.store(job.size - 1, std::memory_order_relaxed);
    begun_.store(wakes_.load(std::memory_order_relaxed), std::memory_order_release);
    begun_.notify_all();
    return now;
  }

  void finish(Job& job) {
    const auto all_are_done = [&] { return left_.load(std::memory_order_acquire) == 0; };
    wait_until(all_are_done, [&] {
      std::unique_lock lock(finishing_);
      finished_.wait_for(lock, std::chrono::milliseconds(50), all_are_done);
      lock.unlock();
      job.interrupt.poll();
    });
  }

  void pause(Barrier::Clock::time_point now) { again_ = now + 100 * team_timeout; }

  void make(int count) {
    try {
      while (int(threads_.size()) < count)
        threads_.emplace_back([this, seen = wakes_.load()] { serve(seen); });
    } catch (const std::system_error&) {  // the system grants no more
    }
  }

  void wake() {
    wakes_.fetch_add(1, std::memory_order_release);
    wakes_.notify_all();
  }

  void serve(std::uint32_t seen) {
    for (;;) {
      wait_until([&] { return wakes_.load(std::memory_order_acquire) != seen; },
                 [&] { wakes_.wait(seen, std::memory_order_acquire); });
      Job* job = nullptr;
      int rank = 0;
      {
        const std::lock_guard lock(joining_);
        if (leaving_) return;
        seen = wakes_.load(std::memory_order_relaxed);
        if (openings_ > joined_.load(std::memory_order_relaxed)) {
          job = job_;
          rank = 1 + joined_.fetch_add(1, std::memory_order_release);
        }
      }
      if (!job) continue;
      std::uint32_t begun = 0;
      wait_until([&] { return (begun = begun_.load(std::memory_order_acquire)) == seen; },
                 [&] { begun_.wait(begun, std::memory_order_acquire); });
      job->run(rank);
      if (left_.fetch_sub(1, std::memory_order_acq_rel) > 1) continue;
      const std::lock_guard lock(finishing_);
      finished_.notify_one();
    }
  }

  const int forks_ = forks;
  std::vector<std::thread> threads_;
  Barrier::Clock::time_point again_{};  // when a team is tried again
  std::atomic<std::uint32_t> wakes_{0}, begun_{0};
  std::mutex joining_;
  bool leaving_ = false;
  Job* job_ = nullptr;
  int openings_ = 0;  // 0: the team is complete
  std::atomic<int> joined_{0}, left_{0};
  std::mutex finishing_;
  std::condition_variable finished_;
};

// The workers of the calling thread. After a fork the parent's workers are never deleted: their threads do not exist
// here.
class OwnWorkers {
 public:
  ~OwnWorkers() {
    if (workers_ && workers_->are_of_this_process()) delete workers_;
  }
  Workers& get() {
    if (!workers_ || !workers_->are_of_this_process()) workers_ = new Workers;
    return *workers_;
  }

 private:
  Workers* workers_ = nullptr;
};

thread_local OwnWorkers own_workers;
thread_local bool in_team = false;

struct InTeam {
  const bool before = in_team;
  InTeam() { in_team = true; }
  ~InTeam() { in_team = before; }
};

}  // namespace

void Interrupt::set_check(Check check) { the_check = check; }

void Interrupt::poll() {
  constexpr auto between_checks = std::chrono::milliseconds(200);
  const auto now = std::chrono::steady_clock::now();
  const bool first = next_ == std::chrono::steady_clock::time_point{};
  const bool early = first || now < next_;
  if (first || !early) next_ = now + between_checks;
  const Check check = the_check;
  if (early || !check || failure_) return;
  try {
    check();
  } catch (...) {
    failure_ = std::current_exception();
    ended_.store(true, std::memory_order_relaxed);
  }
}

int most_threads() {
#if defined(_OPENMP)
  return omp_get_max_threads();
#else
  return 1;
#endif
}

void run_team(int threads, void (*work)(void*, const Team&), void* context) {
  Job job{work, context};
  if (threads > 1 && !in_team) {
    const InTeam inside;
    own_workers.get().run(job, threads - 1);
  } else {
    job.run(0);
  }
  job.conclude();
}

}  // namespace pd
