// Threads that work on one task together.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>

namespace pd {

// Polls done() so many times; returns whether it became true.
template <class Done>
bool spin_until(int polls, Done done) {
  for (int poll = 0; poll < polls; ++poll) {
    if (done()) return true;
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("yield");
#endif
  }
  return false;
}

// Waits until done(): a few microseconds of polling, since most waits are as short, then by sleep(). On a busy
// machine a polling thread would keep the awaited one from running.
template <class Done, class Sleep>
void wait_until(Done done, Sleep sleep) {
  if (spin_until(500, done)) return;
  while (!done()) sleep();
}

// How long the caller waits for a team before it continues alone. An idle core wakes up far sooner; another process
// keeps a core for longer.
constexpr std::chrono::milliseconds team_timeout{1};

// Interrupts a call before its work is done, as Ctrl-C asks for. The calling thread polls now and then.
class Interrupt {
 public:
  // Throws the exception that ends the call, or returns. None: no call ends early.
  using Check = void (*)();
  static void set_check(Check check);

  // Called by the calling thread after so much work [vertices]: short calls never read the clock.
  void count_work(std::int64_t work) {
    work_ += work;
    if (work_ < work_between_polls) return;
    work_ = 0;
    poll();
  }
  // Runs the check, unless the last one is recent.
  void poll();
  bool ended() const { return ended_.load(std::memory_order_relaxed); }
  // Throws the exception of the check.
  void conclude() const {
    if (failure_) std::rethrow_exception(failure_);
  }

 private:
  static constexpr std::int64_t work_between_polls = 1 << 16;  // some milliseconds

  std::int64_t work_ = 0;
  std::chrono::steady_clock::time_point next_{};
  std::exception_ptr failure_;
  std::atomic<bool> ended_{false};
};

// Barrier of a team's members.
class Barrier {
 public:
  using Clock = std::chrono::steady_clock;

  explicit Barrier(Interrupt& interrupt) : interrupt_(interrupt) {}
  void begin(Clock::time_point now) { begun_ = now; }

  void wait(int size, bool calls) {
    const std::uint32_t phase = phase_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == size) {
      arrived_.store(0, std::memory_order_relaxed);
      ended_ = interrupt_.ended();
      is_split_ = slow();
      phase_.fetch_add(1, std::memory_order_acq_rel);
      phase_.notify_all();
      return;
    }
    const auto all_arrived = [&] { return phase_.load(std::memory_order_acquire) != phase; };
    // most waits are too short to be timed
    if (spin_until(50, all_arrived)) return;
    const auto before = calls ? Clock::now() : Clock::time_point{};
    wait_until(all_arrived, [&] { phase_.wait(phase, std::memory_order_acquire); });
    if (calls) count(before, size);
  }
  // The interrupt's state when the last member arrived: the same for all members until the next barrier.
  bool ended() const { return ended_; }
  // Whether the team was `slow` then.
  bool is_split() const { return is_split_; }
  // Whether the calling thread would have been faster alone: it has waited longer than the others' shares take.
  bool slow() const { return slow_.load(std::memory_order_relaxed); }

 private:
  void count(Clock::time_point before, int size) {
    interrupt_.poll();
    const auto now = Clock::now();
    waited_ += now - before;
    const auto others_share = (size - 1) * (now - begun_ - waited_);
    if (waited_ > others_share + team_timeout) slow_.store(true, std::memory_order_relaxed);
  }

  Interrupt& interrupt_;
  std::atomic<int> arrived_{0};
  std::atomic<std::uint32_t> phase_{0};
  bool ended_ = false, is_split_ = false;
  std::atomic<bool> slow_{false};
  Clock::time_point begun_{};
  Clock::duration waited_{0};
};

// Thrown in members that the team continues without.
struct Dismissed {};

struct Team {
  int rank = 0;
  mutable int size = 1;               // may become 1 in `ended`
  mutable Barrier* shared = nullptr;  // null for a team of one
  Interrupt* interrupt = nullptr;
  bool calls = false;  // the calling thread

  void barrier() const {
    if (shared) shared->wait(size, calls);
  }
  // This member as a team of one.
  Team alone() const { return {0, 1, nullptr, interrupt, calls}; }
  // Whether to stop, after so much work [vertices]. Between two barriers all members get the same answer. No
  // operation is half done here, so the calling thread continues alone if other processes keep the members from their
  // cores. Its share grows then, but no number changes, as none depends on the size of a team.
  bool ended(std::int64_t work) const {
    if (calls) interrupt->count_work(work);
    if (shared && shared->is_split()) {
      if (!calls) throw Dismissed{};
      size = 1;
      shared = nullptr;
    }
    return shared ? shared->ended() : interrupt->ended();
  }
  // first item of this member's share of `count`, and of the next member's
  std::int64_t begin(std::int64_t count) const { return count * rank / size; }
  std::int64_t end(std::int64_t count) const { return count * (rank + 1) / size; }
};

// How many threads this process may use at most.
int most_threads();

// Calls work(context, team) in every thread of a team: the caller and those of at most `threads` - 1 others that
// start in time. Inside another team the caller works alone. Throws the exception of a member or of the interrupt
// check.
void run_team(int threads, void (*work)(void* context, const Team& team), void* context);

template <class Work>
void run_team(int threads, Work work) {
  run_team(
      threads, [](void* context, const Team& team) { (*static_cast<Work*>(context))(team); },
      &work);
}

}  // namespace pd
