// The fused kernel in one precision. Kernels with contacts are compiled in separate sources, to
// parallelise the build.
#pragma once
#include "cuda/fused/cluster_members.h"
#include "cuda/fused/rigid.h"
#include "cuda/fused/start.h"
#include "cuda/fused/visit.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

// Threads of a block that has a multiprocessor to itself: the maximum, and the number that leaves
// registers for prefetched data.
template <class T>
constexpr int most_grid_threads = int(most_patch_threads(sizeof(T)));
template <class T>
constexpr int global_memory_threads = sizeof(T) == 4 ? 384 : 192;

// Threads that fit in a multiprocessor's registers, for blocks with one environment each.
template <class T>
constexpr int resident_threads = sizeof(T) == 4 ? 640 : 256;

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared, int Threads>
__global__ void __launch_bounds__(Threads, 1)
    fused_step(const __grid_constant__ FusedCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, false> runner(call, shared);
  const int team = Kind != Blocks::one ? int(blockIdx.x) / call.step.plan.patches : int(blockIdx.x);
  for (std::int64_t e = team; e < call.step.batch; e += call.teams) runner.rollout(e);
  // no block may exit while others can still write to its shared memory
  if constexpr (Kind == Blocks::cluster) cluster_barrier();
}

template <class T>
using FusedKernel = void (*)(FusedCall<T>);

template <class T, bool HasContacts, bool HasFreePieces>
FusedKernel<T> fused_kernel_for(Blocks kind, bool in_shared, int threads) {
  constexpr int most = most_grid_threads<T>;
  if constexpr (has_poisson_ratio) {
    if (kind == Blocks::cluster) return nullptr;  // a group may lie in two patches of a cluster
  } else if (kind == Blocks::cluster) {
    constexpr int few = most * 5 / 8;  // leaves more registers per thread
    if (threads <= few) {
      if (in_shared) return fused_step<T, HasContacts, HasFreePieces, Blocks::cluster, true, few>;
      return fused_step<T, HasContacts, HasFreePieces, Blocks::cluster, false, few>;
    }
    if (in_shared) return fused_step<T, HasContacts, HasFreePieces, Blocks::cluster, true, most>;
    return fused_step<T, HasContacts, HasFreePieces, Blocks::cluster, false, most>;
  }
  if (kind == Blocks::grid) {
    if (in_shared) return fused_step<T, HasContacts, HasFreePieces, Blocks::grid, true, most>;
    return fused_step<T, HasContacts, HasFreePieces, Blocks::grid, false, global_memory_threads<T>>;
  }
  if (in_shared)
    return fused_step<T, HasContacts, HasFreePieces, Blocks::one, true, resident_threads<T>>;
  return fused_step<T, HasContacts, HasFreePieces, Blocks::one, false, resident_threads<T>>;
}

}  // namespace pd::inline PD_TARGET
