// Thread block clusters, whose blocks access each other's shared memory (compute capability 9.0 and
// newer). On older devices the host never launches a kernel that calls these functions.
#pragma once
#include "cuda/common/memory.h"
#include "views/shared_memory.h"

#include <cstdint>

#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 900
#define PD_HAS_CLUSTERS 1
#else
#define PD_HAS_CLUSTERS 0
#endif

// Memory order of ByteBarrier::wait. PTX ISA 8.6 can acquire shared memory alone.
#if __CUDACC_VER_MAJOR__ * 100 + __CUDACC_VER_MINOR__ >= 1208
#define PD_SHARED_WAIT "relaxed"
#define PD_SHARED_FENCE "fence.acquire.sync_restrict::shared::cluster.cluster;"
#else
#define PD_SHARED_WAIT "acquire"
#define PD_SHARED_FENCE ""
#endif

namespace pd::inline PD_TARGET {

// Cluster barrier: earlier writes of all its threads are visible after it.
PD_DEVICE void cluster_barrier() {
#if PD_HAS_CLUSTERS
  asm volatile(
      "barrier.cluster.arrive.release;\n\t"
      "barrier.cluster.wait.acquire;" ::
          : "memory");
#endif
}

using SharedAddress = std::uint32_t;  // in this block's shared memory or in the cluster's

PD_DEVICE SharedAddress shared_address(const void* in_shared) {
  return SharedAddress(__cvta_generic_to_shared(in_shared));
}

// Maps an address in shared memory to the same place in another block of the cluster.
PD_DEVICE SharedAddress at_block(SharedAddress here, int rank) {
  SharedAddress there = here;
#if PD_HAS_CLUSTERS
  asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(there) : "r"(here), "r"(rank));
#endif
  return there;
}

// A transaction barrier (mbarrier). A phase completes after one arrival and the expected number of
// bytes from other blocks.
class ByteBarrier {
 public:
  PD_DEVICE explicit ByteBarrier(std::uint64_t* word) : at_(shared_address(word)) {}

  PD_DEVICE SharedAddress address() const { return at_; }

  // called by one thread, before a cluster barrier
  PD_DEVICE void init() const {
#if PD_HAS_CLUSTERS
    asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" ::"r"(at_) : "memory");
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
#endif
  }

  // called by one thread, once per round
  PD_DEVICE void expect(int bytes) const {
#if PD_HAS_CLUSTERS
    asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(at_), "r"(bytes)
                 : "memory");
#endif
  }

  // `parity`: that of the number of earlier rounds. Data that other blocks stored in shared memory
  // is visible after the wait. An acquire of all memory would also invalidate the L1 cache.
  PD_DEVICE void wait(unsigned parity) const {
#if PD_HAS_CLUSTERS
    unsigned through;
    do {
      asm volatile("{.reg .pred p; mbarrier.try_wait.parity." PD_SHARED_WAIT
                   ".cluster.shared::cta.b64 p, [%1], %2; selp.u32 %0, 1, 0, p;}"
                   : "=r"(through)
                   : "r"(at_), "r"(parity)
                   : "memory");
    } while (!through);
    asm volatile(PD_SHARED_FENCE ::: "memory");
#endif
  }

 private:
  SharedAddress at_;
};

// Loads from another block's shared memory.
PD_DEVICE float read_shared(SharedAddress from, float) {
  float number = 0;
#if PD_HAS_CLUSTERS
  asm volatile("ld.shared::cluster.f32 %0, [%1];" : "=f"(number) : "r"(from) : "memory");
#endif
  return number;
}
PD_DEVICE double read_shared(SharedAddress from, double) {
  double number = 0;
#if PD_HAS_CLUSTERS
  asm volatile("ld.shared::cluster.f64 %0, [%1];" : "=d"(number) : "r"(from) : "memory");
#endif
  return number;
}

// Stores to another block's shared memory, whose barrier counts the bytes.
PD_DEVICE void send(SharedAddress to, SharedAddress barrier, double a) {
#if PD_HAS_CLUSTERS
  asm volatile(
      "st.async.shared::cluster.mbarrier::complete_tx::bytes.f64 [%0], %1, [%2];" ::"r"(to), "d"(a),
      "r"(barrier)
      : "memory");
#endif
}

// The same stores, predicated by `wanted` without a branch.
PD_DEVICE void send(SharedAddress to, SharedAddress barrier, const Quad<float>& a, bool wanted) {
#if PD_HAS_CLUSTERS
  asm volatile(
      "{.reg .pred p; setp.ne.b32 p, %6, 0; @p "
      "st.async.shared::cluster.mbarrier::complete_tx::bytes.v4.f32 [%0], {%1, %2, %3, %4}, "
      "[%5];}" ::"r"(to),
      "f"(a.x), "f"(a.y), "f"(a.z), "f"(a.w), "r"(barrier), "r"(int(wanted))
      : "memory");
#endif
}

PD_DEVICE void send(SharedAddress to, SharedAddress barrier, const Quad<double>& a, bool wanted) {
#if PD_HAS_CLUSTERS
  asm volatile(
      "{.reg .pred p; setp.ne.b32 p, %6, 0; @p "
      "st.async.shared::cluster.mbarrier::complete_tx::bytes.v2.f64 [%0], {%1, %2}, [%5]; @p "
      "st.async.shared::cluster.mbarrier::complete_tx::bytes.v2.f64 [%0 + 16], {%3, %4}, "
      "[%5];}" ::"r"(to),
      "d"(a.x), "d"(a.y), "d"(a.z), "d"(a.w), "r"(barrier), "r"(int(wanted))
      : "memory");
#endif
}

}  // namespace pd::inline PD_TARGET
