// Blocks that work on one environment together in global memory, with a barrier between phases.
#pragma once
#include "cuda/common/reductions.h"

namespace pd::inline PD_TARGET {

// The distribution of work never affects the order of a sum, so the bits do not depend on `blocks`.
class BlockTeam {
 public:
  // `counter` starts at zero and belongs to the team; all blocks of the launch must be resident
  PD_DEVICE BlockTeam(int rank, int blocks, unsigned* counter)
      : rank_(rank), blocks_(blocks), counter_(counter) {}

  PD_DEVICE int rank() const { return rank_; }
  PD_DEVICE int blocks() const { return blocks_; }
  PD_DEVICE int thread() const { return warp() * warp_size + int(threadIdx.x) % warp_size; }
  PD_DEVICE int threads() const { return blocks_ * int(blockDim.x); }
  // consecutive warps lie in different blocks, so a few tasks spread over all multiprocessors
  PD_DEVICE int warp() const { return int(threadIdx.x) / warp_size * blocks_ + rank_; }
  PD_DEVICE int warps() const { return threads() / warp_size; }

  // Team barrier: earlier writes of all its threads are visible after it.
  PD_DEVICE void barrier() {
    __syncthreads();
    if (blocks_ == 1) return;
    expected_arrivals_ += unsigned(blocks_);
    if (threadIdx.x == 0) {
      asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(counter_) : "memory");
      unsigned arrived;
      do {
        asm volatile("ld.acquire.gpu.global.u32 %0, [%1];"
                     : "=r"(arrived)
                     : "l"(counter_)
                     : "memory");
      } while (int(arrived - expected_arrivals_) < 0);
    }
    __syncthreads();
  }

 private:
  int rank_, blocks_;
  unsigned* counter_;
  unsigned expected_arrivals_ = 0;  // count at which the next barrier opens
};

}  // namespace pd::inline PD_TARGET
