// Signals between warps of a block, and overlap of consecutive kernels.
#pragma once
#include "cuda/common/cluster.h"

// try_wait suspends the thread in hardware (compute capability 9.0 and newer)
#if PD_HAS_CLUSTERS
#define PD_SIGNAL_WAIT "try_wait"
#else
#define PD_SIGNAL_WAIT "test_wait"
#endif

namespace pd::inline PD_TARGET {

// A reusable signal (PTX mbarrier): some threads arrive, others wait without arriving. Every thread
// arrives for itself. One arrival per warp would take as long, and compute-sanitizer would not see
// the writes of its other lanes.
class Signal {
 public:
  PD_DEVICE explicit Signal(std::uint64_t* word) : at_(shared_address(word)) {}

  // called by one thread, before __syncthreads
  PD_DEVICE void init(int threads) const {
    asm volatile("mbarrier.init.shared.b64 [%0], %1;" ::"r"(at_), "r"(threads) : "memory");
  }

  PD_DEVICE void arrive() const {
    asm volatile("{.reg .b64 turn; mbarrier.arrive.shared.b64 turn, [%0];}" ::"r"(at_) : "memory");
  }

  // writes before the arrivals are visible after the wait
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

// A kernel launched by Launcher::run_overlapped starts before the previous kernel has ended. Two
// rules hold for each such kernel. First, at least one block ends only after
// wait_for_previous_kernel, so the end of a kernel implies the end of all earlier ones. Second, at
// least one block triggers the next kernel only after that wait, so a kernel starts when all but
// the previous one have ended.
//
// Before the wait, a kernel may therefore read three kinds of data. Results of kernels before the
// previous one, through the L2 cache, which sees all writes. Halo messages of the previous kernel.
// The plan and the weights, provided that kernels launched without overlap separate their writer
// from the first overlapped kernel. All kernels but stream_shared wait before they read anything
// else.

// Waits until the previous kernel has ended and its writes are visible.
PD_DEVICE void wait_for_previous_kernel() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Called by one thread of every block, by the rules above: the next kernel may start where
// resources are free.
PD_DEVICE void launch_dependents() {
#if PD_HAS_CLUSTERS
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

}  // namespace pd::inline PD_TARGET

#undef PD_SIGNAL_WAIT
