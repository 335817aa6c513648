// How the patches of a cluster send each other the forces on vertices that they share: straight into the receiver's shared
// memory, a place for each sender, so that all add up the same numbers in the order of patches.
#pragma once
#include "cuda/cluster.h"
#include "cuda/exchange.h"
#include "cuda/patch.h"

namespace pd::inline PD_TARGET {

// of a seat others are counted in four bits, and names have four for the patch
static_assert(most_cluster_blocks <= 16);

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
    unsigned left = sharers_;
#pragma unroll
    for (int j = 0; j < most_named; ++j, left &= left - 1) {
      const int p = left ? __ffs(int(left)) - 1 : own_;
      names_[j / 2] |= unsigned(p << seat_bits | (left ? seat_[p * seats_ + seat] : 0))
                       << 16 * (j % 2);
    }
    const int sharers = __popc(sharers_);
    most_sharers_ = __reduce_max_sync(whole_warp, sharers);
    int letters = 0;
    const int others = sharers > 0 ? sharers - 1 : 0;
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

  // Whole warps; threads whose seat is not shared send nothing.
  PD_DEVICE void send(const Vec3<T>& force, unsigned round) const {
    const Quad<T> letter = quad(force);
    const int seat = threadIdx.x;
    Quad<T>* const row = place(round) + own_ * seats_;
    if (sharers_) row[seat] = letter;
    const SharedAddress to = shared_address(row), meets = barrier(round).address();
    const auto post = [&](int p, int there, bool wanted) {
      pd::send(at_block(to + there * int(sizeof(Quad<T>)), p), at_block(meets, p), letter, wanted);
    };
    const int sharers = __popc(sharers_);
#pragma unroll
    for (int j = 0; j < most_named; ++j) {
      if (j >= most_sharers_) return;
      const unsigned there = name(j);
      const int p = int(there >> seat_bits);
      post(p, int(there & (most_seats - 1)), j < sharers && p != own_);
    }
    if (sharers <= most_named) return;
    int count = 0;
    for (unsigned left = sharers_; left; left &= left - 1) {
      if (++count <= most_named) continue;
      const int p = __ffs(int(left)) - 1;
      post(p, seat_[p * seats_ + seat], p != own_);
    }
  }

  // until all letters are there
  PD_DEVICE void wait(unsigned round) const { barrier(round).wait((round - 1) >> 1 & 1); }

  // Whole warps, after the wait: the sum of what all patches sent, zero where the seat is not shared.
  PD_DEVICE Vec3<T> receive(unsigned round) const {
    const Quad<T>* const letters = place(round) + threadIdx.x;
    const int sharers = __popc(sharers_);
    Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll
    for (int first = 0; first < most_named; first += 4) {
      if (first >= most_sharers_) return sum;
      // asked for at once
      Vec3<T> part[4];
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        part[j] = {T(0), T(0), T(0)};
        if (first + j < sharers)
          part[j] = vec3(letters[int(name(first + j) >> seat_bits) * seats_]);
      }
#pragma unroll
      for (int j = 0; j < 4; ++j) sum = sum + part[j];
    }
    if (sharers <= most_named) return sum;
    int count = 0;
    for (unsigned left = sharers_; left; left &= left - 1) {
      if (++count > most_named) sum = sum + vec3(letters[(__ffs(int(left)) - 1) * seats_]);
    }
    return sum;
  }

 private:
  static constexpr int barriers_bytes = 16;
  static constexpr int most_named = 8;  // patches of a vertex that are known without a look
  static constexpr int seat_bits = 12, most_seats = 1 << seat_bits;

  // The j-th patch that has the vertex of this thread's seat, and in the lower bits which seat it has there.
  PD_DEVICE unsigned name(int j) const { return names_[j / 2] >> 16 * (j % 2) & 0xffff; }

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
  unsigned names_[most_named / 2] = {};  // two of 16 bits each
  unsigned sharers_ = 0;  // a bit for each patch that has the vertex of this thread's seat
  int most_sharers_ = 0;  // such patches of a thread of this warp
  int expected_ =
      0;  // bytes a round: at most 512 seats of 15 letters, and a barrier counts to 2^20
};

}  // namespace pd::inline PD_TARGET
