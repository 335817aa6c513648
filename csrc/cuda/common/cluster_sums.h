// Exchange of sums in a cluster: each block sends its own sums to all blocks, itself included.
#pragma once
#include "cuda/common/cluster.h"
#include "cuda/common/reductions.h"

namespace pd::inline PD_TARGET {

static_assert(sums_count == 3);  // size of cluster_sums_bytes

// Layout in shared memory (cluster_sums_bytes): two barriers, then numbers [2, blocks, sums_count].
class ClusterSums {
 public:
  PD_DEVICE explicit ClusterSums(std::byte* shared)
      : barrier_(reinterpret_cast<std::uint64_t*>(shared)),
        numbers_(reinterpret_cast<double*>(barrier_ + 2)) {}

  // called by one thread, before a cluster barrier
  PD_DEVICE void init() const {
    for (int round = 0; round < 2; ++round) barrier(round).init();
  }

  // called by one thread, once per round: the count that all blocks together will send; rounds
  // start at 1
  PD_DEVICE void expect(unsigned round, int count) const {
    barrier(round).expect(count * int(sizeof(double)));
  }

  PD_DEVICE void send(int to, int from, int n, double number, unsigned round) const {
    pd::send(at_block(shared_address(place(from, n, round)), to),
             at_block(barrier(round).address(), to), number);
  }

  PD_DEVICE double receive(int from, int n, unsigned round) const {
    barrier(round).wait((round - 1) >> 1 & 1);
    return *place(from, n, round);
  }

 private:
  PD_DEVICE ByteBarrier barrier(unsigned round) const {
    return ByteBarrier(barrier_ + (round & 1));
  }
  PD_DEVICE double* place(int block, int n, unsigned round) const {
    return numbers_ + ((round & 1) * int(most_cluster_blocks) + block) * sums_count + n;
  }

  std::uint64_t* barrier_;
  double* numbers_;
};

}  // namespace pd::inline PD_TARGET
