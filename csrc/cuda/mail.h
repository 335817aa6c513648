// How the patches of a cluster send each other the forces on vertices that they share: straight into the receiver's shared
// memory, a place for each sender, so that all add up the same numbers in the order of patches.
#pragma once
#include "cuda/cluster.h"
#include "cuda/exchange.h"
#include "cuda/patch.h"

namespace pd::inline PD_TARGET {

static_assert(most_cluster_blocks <= 16);  // others of a seat are counted in four bits

// Each thread has the seat of its number: shared slots have the first ones. In shared memory, mail_bytes: two barriers, letters
// [2, patches, seats], and [patches, seats] which seat the vertex has there.
template <class T>
class ClusterMail {
 public:
  // `seats`: the most that any patch shares
  PD_DEVICE ClusterMail(std::byte* shared, int seats, int patches, int own)
      : barrier_(reinterpret_cast<std::uint64_t*>(shared)),
        letters_(reinterpret_cast<Quad<T>*>(shared + barriers_bytes)),
        seat_(reinterpret_cast<std::uint16_t*>(letters_ + 2 * std::int64_t(patches) * seats)),
        seats_(seats),
        patches_(patches),
        own_(own) {}

  // All threads, before a barrier of the cluster; `before`: rows of `senders`, in the order of patches, that others have.
  PD_DEVICE void open(const Patch<T>& patch, const Senders* senders, int before) {
    const int seat = threadIdx.x;
    for (int p = 0, row = before + seat, more = seat < patch.shared(); more > 0; row = more) {
      const Senders names = senders[row];
      for (int slot : names.slot) {
        if (slot < 0) break;
        while (slot >= patch.plan.patch_slot[p + 1]) ++p;
        sharers_ |= 1u << p;
        const int interior = patch.plan.patch_vertex[p + 1] - patch.plan.patch_vertex[p];
        seat_[p * seats_ + seat] = std::uint16_t(slot - patch.plan.patch_slot[p] - interior);
      }
      more = names.more;
    }
    unsigned from = sharers_, to = sharers_ & ~(1u << own_);
#pragma unroll
    for (int j = 0; j < most_near; ++j, from &= from - 1) {
      column_[j] = (__ffs(int(from)) - 1) * seats_ + seat;
    }
#pragma unroll
    for (int j = 0; j < most_near - 1; ++j, to &= to - 1) {
      const int p = to ? __ffs(int(to)) - 1 : own_;
      const int there = to ? seat_[p * seats_ + seat] : 0;
      to_[j] = at_block(shared_address(letters_ + own_ * seats_ + there), p);
      meets_[j] = at_block(barrier(0).address(), p);
    }
    int letters = 0;
    const int others = sharers_ ? __popc(sharers_) - 1 : 0;
    for (int bit = 0; bit < 4; ++bit) letters += __syncthreads_count(others >> bit & 1) << bit;
    expected_ = letters * int(sizeof(Quad<T>));
    if (threadIdx.x == 0) {
      for (int round = 0; round < 2; ++round) barrier(round).open();
    }
  }

  // One thread a round, numbered from 1; nobody waits where nothing is shared.
  PD_DEVICE void expect(unsigned round) const {
    if (expected_ > 0) barrier(round).expect(expected_);
  }

  // A thread with a seat that is shared.
  PD_DEVICE void send(const Vec3<T>& force, unsigned round) const {
    const Quad<T> letter = quad(force);
    const int seat = threadIdx.x, sharers = __popc(sharers_);
    Quad<T>* const here = place(round);
    here[own_ * seats_ + seat] = letter;
    const int second = (round & 1) * patches_ * seats_ * int(sizeof(Quad<T>));
    const int second_barrier = (round & 1) * int(sizeof(std::uint64_t));
#pragma unroll
    for (int j = 0; j < most_near - 1; ++j) {
      if (j < sharers - 1) pd::send(to_[j] + second, meets_[j] + second_barrier, letter);
    }
    if (sharers <= most_near) return;
    const SharedAddress row = shared_address(here + own_ * seats_);
    const SharedAddress meets = barrier(round).address();
    int near = 0;
    for (unsigned left = sharers_ & ~(1u << own_); left; left &= left - 1) {
      if (++near < most_near) continue;
      const int p = __ffs(int(left)) - 1;
      const SharedAddress to = row + seat_[p * seats_ + seat] * int(sizeof(Quad<T>));
      pd::send(at_block(to, p), at_block(meets, p), letter);
    }
  }

  // until all letters are there
  PD_DEVICE void wait(unsigned round) const { barrier(round).wait((round - 1) >> 1 & 1); }

  // The thread that sent, after the wait: the sum of what all patches sent.
  PD_DEVICE Vec3<T> receive(unsigned round) const {
    Vec3<T> sum = {T(0), T(0), T(0)};
    const Quad<T>* const letters = place(round);
    const int sharers = __popc(sharers_);
#pragma unroll
    for (int j = 0; j < most_near; ++j) {
      if (j < sharers) sum = sum + vec3(letters[column_[j]]);
    }
    if (sharers <= most_near) return sum;
    int near = 0;
    for (unsigned left = sharers_; left; left &= left - 1) {
      if (++near <= most_near) continue;
      sum = sum + vec3(letters[(__ffs(int(left)) - 1) * seats_ + int(threadIdx.x)]);
    }
    return sum;
  }

 private:
  static constexpr int barriers_bytes = 16;
  static constexpr int most_near = 4;  // patches of a vertex whose places are known beforehand

  PD_DEVICE ByteBarrier barrier(unsigned round) const {
    return ByteBarrier(barrier_ + (round & 1));
  }
  PD_DEVICE Quad<T>* place(unsigned round) const {
    return letters_ + std::int64_t(round & 1) * patches_ * seats_;
  }

  std::uint64_t* barrier_;
  Quad<T>* letters_;
  std::uint16_t* seat_;
  int seats_, patches_, own_;
  // of the first patches that have the vertex of this thread's seat: where letters from there lie, and in order without
  // this one where letters to there go and which barrier counts them
  int column_[most_near];
  SharedAddress to_[most_near - 1], meets_[most_near - 1];
  unsigned sharers_ = 0;  // a bit for each patch that has the vertex of this thread's seat
  int expected_ =
      0;  // bytes a round: at most 512 seats of 15 letters, and a barrier counts to 2^20
};

}  // namespace pd::inline PD_TARGET
