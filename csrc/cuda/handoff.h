// What some warps of a block wait for while others go on, and what a kernel that starts early waits for.
#pragma once
#include "cuda/cluster.h"

// from compute capability 9.0 on the hardware waits for a while
#if PD_HAS_CLUSTERS
#define PD_SIGNAL_WAIT "try_wait"
#else
#define PD_SIGNAL_WAIT "test_wait"
#endif

namespace pd::inline PD_TARGET {

// Turn after turn: a barrier in shared memory (mbarrier of PTX) which those who wait do not come to. Every thread gives its
// part: one for its whole warp would take as long, and compute-sanitizer would not see what the others have done before.
class Signal {
 public:
  PD_DEVICE explicit Signal(std::uint64_t* word) : at_(shared_address(word)) {}

  // one thread, before __syncthreads
  PD_DEVICE void init(int threads) const {
    asm volatile("mbarrier.init.shared.b64 [%0], %1;" ::"r"(at_), "r"(threads) : "memory");
  }

  PD_DEVICE void arrive() const {
    asm volatile("{.reg .b64 turn; mbarrier.arrive.shared.b64 turn, [%0];}" ::"r"(at_) : "memory");
  }

  // what they did before they gave it can be read after
  PD_DEVICE void wait(unsigned turn) const {
    unsigned complete;
    while (true) {
      asm volatile("{.reg .pred p; mbarrier." PD_SIGNAL_WAIT
                   ".parity.shared.b64 p, [%1], %2; selp.u32 %0, 1, 0, p;}"
                   : "=r"(complete)
                   : "r"(at_), "r"(turn & 1)
                   : "memory");
      if (complete) break;
#if !PD_HAS_CLUSTERS
      __nanosleep(20);
#endif
    }
  }

 private:
  SharedAddress at_;
};

// Kernels that Launcher::run_overlapped launches start before the one before them has ended. Two things hold of each of them:
// some block ends only after it has waited (wait_for_previous_kernel), so that the end of a kernel is the end of all before it; and
// some block lets the next one start only after it has waited, so that a kernel starts when all but the one before it have
// ended. So what a kernel reads without waiting has to be of kernels before the one before it, by the L2 cache, which sees all
// writes; or letters of the one before it; or a plan or weights, of pairs and of patches, as long as kernels that nobody starts
// early stand between those that write them and the first that is. All but stream_shared wait for everything else.

// Until the kernel before has ended and what it wrote is there.
PD_DEVICE void wait_for_previous_kernel() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// One thread of every block, see above: the next kernel may start wherever there is room.
PD_DEVICE void launch_dependents() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

}  // namespace pd::inline PD_TARGET

#undef PD_SIGNAL_WAIT
