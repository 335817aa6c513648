// Reductions over all threads that work on an environment. Each thread contributes a partial value.
// After a barrier, the leading warp reduces the block and exchanges the result with the leading
// warps of the other blocks.
#pragma once
#include "cuda/common/cluster_sums.h"
#include "cuda/common/halo_messages.h"

namespace pd::inline PD_TARGET {

// How blocks share an environment: one block each; a cluster with distributed shared memory; or a
// grid of blocks.
enum class Blocks { one, cluster, grid };

// The block's partial and total sums, in shared memory.
struct TeamTotals {
  double warp_sum[sums_count][warp_size];
  double total[sums_count];
};

// The last warp leads: it is idle in the last round of pairs when there are several rounds.
PD_DEVICE bool in_leading_warp() { return threadIdx.x + warp_size >= blockDim.x; }
PD_DEVICE bool is_leader() { return threadIdx.x + warp_size == blockDim.x; }
PD_DEVICE int lane() { return int(threadIdx.x) % warp_size; }

template <Blocks Kind>
class TeamSums {
  static constexpr bool Many = Kind != Blocks::one;  // several blocks, one per patch
  static constexpr int early_barrier = 1;            // hardware barrier 0 is __syncthreads

 public:
  // `mailbox` [2, patches, sums_count] starts with zero tags (grid only); `cluster` is for clusters
  // only
  PD_DEVICE TeamSums(TeamTotals& totals, TaggedWord* mailbox, ClusterSums cluster, int patch,
                     int patches)
      : totals_(&totals), mailbox_(mailbox), cluster_(cluster), patch_(patch), patches_(patches) {}

  PD_DEVICE double total(int n) const { return totals_->total[n]; }

  // Called by all threads before a barrier: contributes the first `count` values.
  template <class Op>
  PD_DEVICE void store_partial(const double (&value)[sums_count], int count, Op op) {
    count_ = count;
    partials_ = blockDim.x / warp_size;
#pragma unroll
    for (int n = 0; n < sums_count; ++n) {
      if (n >= count) break;
      const double sum = warp_reduce(value[n], op);
      if (lane() == 0) totals_->warp_sum[n][threadIdx.x / warp_size] = sum;
    }
  }

  // The same contribution, which the leading warp may send before that barrier.
  template <class Op>
  PD_DEVICE void store_partial_early(const double (&value)[sums_count], int count, Op op) {
    store_partial(value, count, op);
    __syncwarp();
    if (!in_leading_warp())
      asm volatile("bar.arrive %0, %1;" ::"n"(early_barrier), "r"(blockDim.x) : "memory");
  }
  // Leading warp, in place of store_partial: reduces `values` [threads], which all threads wrote
  // before a barrier.
  template <class Op>
  PD_DEVICE void gather(const double* values, Op op) {
    double sum = Op::identity;
    for (int i = lane(); i < int(blockDim.x); i += warp_size) sum = op(sum, values[i]);
    totals_->warp_sum[0][lane()] = sum;
    count_ = 1;
    partials_ = warp_size;
    __syncwarp();
  }
  // Leading warp: waits until all warps have called store_partial_early.
  PD_DEVICE void wait_for_early() const {
    __syncwarp();
    asm volatile("bar.sync %0, %1;" ::"n"(early_barrier), "r"(blockDim.x) : "memory");
  }

  // Leading warp: sends the block's sums to the other blocks.
  template <class Op>
  PD_DEVICE void send(Op op) {
    ++round_;
#pragma unroll 1
    for (int n = 0; n < count_; ++n) {
      const double sum =
          warp_reduce(lane() < partials_ ? totals_->warp_sum[n][lane()] : Op::identity, op);
      if constexpr (Kind == Blocks::cluster) {
        if (n == 0 && lane() == 0) cluster_.expect(round_, count_ * patches_);
        if (lane() < patches_) cluster_.send(lane(), patch_, n, sum, round_);
      }
      if (lane() != 0) continue;
      if constexpr (Kind == Blocks::grid) {
        store_tagged(mailbox(patch_, n), {std::uint64_t(__double_as_longlong(sum)), round_});
      } else if constexpr (Kind == Blocks::one) {
        totals_->total[n] = sum;
      }
    }
    __syncwarp();
  }

  // Leading warp: receives the sums of all blocks; every block gets the same bits.
  template <class Op>
  PD_DEVICE void receive(Op op) {
    if constexpr (Many) {
#pragma unroll 1
      for (int n = 0; n < count_; ++n) {
        double mine = Op::identity;
        if constexpr (Kind == Blocks::grid) {
          mine = reduce_over_patches<Op>(mailbox(0, n), patches_, round_);
        } else if (lane() < patches_) {
          mine = cluster_.receive(lane(), n, round_);
        }
        __syncwarp();
        const double sum = warp_reduce(mine, op);
        if (lane() == 0) totals_->total[n] = sum;
      }
    }
    __syncwarp();
  }

  // Called by all threads; the totals are valid on return. `Syncs`: also makes all earlier writes
  // of the team visible to all its threads.
  template <bool Syncs = false, class Op>
  PD_DEVICE void all_reduce(const double (&value)[sums_count], int count, Op op) {
    store_partial(value, count, op);
    __syncthreads();
    if (in_leading_warp()) {
      if constexpr (Syncs) __threadfence();
      send(op);
      receive(op);
      if constexpr (Syncs) __threadfence();
    }
    __syncthreads();
  }

  // Barrier over all blocks of the environment; earlier writes are visible after it.
  PD_DEVICE void sync() {
    if constexpr (!Many) {
      __syncthreads();
    } else {
      all_reduce<true>({0, 0, 0}, 1, Add{});
    }
  }

 private:
  PD_DEVICE TaggedWord* mailbox(int patch, int n) const {
    return mailbox_ + ((round_ & 1) * patches_ + patch) * sums_count + n;
  }

  TeamTotals* totals_;
  TaggedWord* mailbox_;
  ClusterSums cluster_;
  int patch_, patches_;
  int count_ = 0;       // values per reduction
  int partials_ = 0;    // partial values per sum
  unsigned round_ = 0;  // exchanges so far
};

}  // namespace pd::inline PD_TARGET
