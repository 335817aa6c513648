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
  PD_DEVICE void open(int threads) const {
    asm volatile("mbarrier.init.shared.b64 [%0], %1;" ::"r"(at_), "r"(threads) : "memory");
  }

  PD_DEVICE void give() const {
    asm volatile("{.reg .b64 turn; mbarrier.arrive.shared.b64 turn, [%0];}" ::"r"(at_) : "memory");
  }

  // what they did before they gave it can be read after
  PD_DEVICE void await(unsigned turn) const {
    unsigned given;
    while (true) {
      asm volatile("{.reg .pred p; mbarrier." PD_SIGNAL_WAIT
                   ".parity.shared.b64 p, [%1], %2; selp.u32 %0, 1, 0, p;}"
                   : "=r"(given)
                   : "r"(at_), "r"(turn & 1)
                   : "memory");
      if (given) break;
#if !PD_HAS_CLUSTERS
      __nanosleep(20);
#endif
    }
  }

 private:
  SharedAddress at_;
};

// In a kernel that Launcher::run_early launched: until the kernel before has ended and what it wrote is there. What kernels of
// the same step write or read comes after it, but for prefetches into L2, which sees all writes. A plan may come before, and
// weights, of pairs and of patches, as long as kernels that nobody starts early stand between those that write them and the
// first that is. All blocks wait, so that whoever waits for them waits for all before them.
PD_DEVICE void await_kernel_before() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// One thread of every block, once it has waited: the next kernel may start wherever there is room.
PD_DEVICE void let_next_kernel_start() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

}  // namespace pd::inline PD_TARGET

#undef PD_SIGNAL_WAIT
