// How the patches of a cluster send each other the forces on vertices that they share: straight into the receiver's shared
// memory, a place for each sender, so that each adds up the same numbers in the order of patches.
#pragma once
#include "cuda/cluster.h"
#include "cuda/exchange.h"
#include "cuda/patch.h"

namespace pd::inline PD_TARGET {

// Shared memory that it lies in begins with two barriers; then letters [2, patches, seats], then who shares a seat [seats], and
// which seat it is there [patches, seats].
template <class T>
class ClusterMail {
 public:
  PD_HD static std::size_t bytes(int seats, int patches) {
    const std::size_t letters = 2 * sizeof(Quad<T>) * seats * patches;
    const std::size_t names = sizeof(std::uint16_t) * seats * (patches + 1);
    return barriers_bytes + letters + (names + 15) / 16 * 16;
  }

  // `seats`: the most that any patch shares
  PD_DEVICE ClusterMail(std::byte* shared, int seats, int patches, int own)
      : barrier_(reinterpret_cast<std::uint64_t*>(shared)),
        letters_(reinterpret_cast<Quad<T>*>(shared + barriers_bytes)),
        sharers_(reinterpret_cast<std::uint16_t*>(letters_ + 2 * std::int64_t(patches) * seats)),
        seat_(sharers_ + seats),
        seats_(seats),
        patches_(patches),
        own_(own) {}

  // All threads, before a barrier of the cluster; `before`: rows of `senders` that other patches have.
  PD_DEVICE void open(const Patch<T>& patch, const Senders* senders, int before) {
    for (int seat = threadIdx.x; seat < patch.shared(); seat += blockDim.x) {
      unsigned sharers = 0;
      int p = 0;
      for (int row = before + seat, more = 1; more > 0; row = more) {
        const Senders names = senders[row];
        for (int slot : names.slot) {
          if (slot < 0) break;
          while (slot >= patch.plan.patch_slot[p + 1]) ++p;
          sharers |= 1u << p;
          const int interior = patch.plan.patch_vertex[p + 1] - patch.plan.patch_vertex[p];
          seat_[p * seats_ + seat] = std::uint16_t(slot - patch.plan.patch_slot[p] - interior);
        }
        more = names.more;
      }
      sharers_[seat] = std::uint16_t(sharers);
    }
    __syncthreads();
    if (threadIdx.x < warp_size) {
      int letters = 0;
      for (int seat = threadIdx.x; seat < patch.shared(); seat += warp_size)
        letters += __popc(sharers_[seat]) - 1;
      expected_ = __reduce_add_sync(whole_warp, letters) * int(sizeof(Quad<T>));
    }
    if (threadIdx.x == 0) {
      for (int round = 0; round < 2; ++round) barrier(round).open();
    }
  }

  // One thread a round, numbered from 1.
  PD_DEVICE void expect(unsigned round) const { barrier(round).expect(expected_); }

  PD_DEVICE void send(int seat, const Vec3<T>& force, unsigned round) const {
    const Quad<T> letter = quad(force);
    Quad<T>* const here = place(round);
    here[own_ * seats_ + seat] = letter;
    const SharedAddress base = shared_address(here), meets = barrier(round).address();
    for (unsigned left = sharers_[seat] & ~(1u << own_); left; left &= left - 1) {
      const int p = __ffs(int(left)) - 1;
      const int at = own_ * seats_ + seat_[p * seats_ + seat];
      pd::send(at_block(base + at * int(sizeof(Quad<T>)), p), at_block(meets, p), letter);
    }
  }

  // The sum of what all patches sent to a seat; threads that are not `here` wait along.
  PD_DEVICE Vec3<T> receive(int seat, bool here, unsigned round) const {
    barrier(round).wait((round - 1) >> 1 & 1);
    Vec3<T> sum = {T(0), T(0), T(0)};
    const Quad<T>* const letters = place(round);
    for (unsigned left = here ? sharers_[seat] : 0; left; left &= left - 1)
      sum = sum + vec3(letters[(__ffs(int(left)) - 1) * seats_ + seat]);
    return sum;
  }

 private:
  static constexpr int barriers_bytes = 16;

  PD_DEVICE ByteBarrier barrier(unsigned round) const {
    return ByteBarrier(barrier_ + (round & 1));
  }
  PD_DEVICE Quad<T>* place(unsigned round) const {
    return letters_ + std::int64_t(round & 1) * patches_ * seats_;
  }

  std::uint64_t* barrier_;
  Quad<T>* letters_;
  std::uint16_t *sharers_, *seat_;
  int seats_, patches_, own_;
  int expected_ = 0;  // bytes a round, known to the first warp
};

}  // namespace pd::inline PD_TARGET
