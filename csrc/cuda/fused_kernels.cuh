// The fused kernel, for one precision. What touches has sources of its own, so that two compilers share the work.
#pragma once
#include "cuda/fused_halo.h"
#include "cuda/fused_rigid.h"
#include "cuda/fused_start.h"
#include "cuda/fused_visit.h"
#include "plan/shared_memory.h"

namespace pd {

// Threads of a block that has a multiprocessor to itself: the most, and those that have registers to look ahead.
template <class T>
constexpr int most_grid_threads = int(most_patch_threads(sizeof(T)));
template <class T>
constexpr int far_threads = sizeof(T) == 4 ? 384 : 192;

// Threads that a multiprocessor has registers for, of blocks that have an environment each.
template <class T>
constexpr int resident_threads = sizeof(T) == 4 ? 640 : 256;

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near, int Threads>
__global__ void __launch_bounds__(Threads, 1)
    fused_step(const __grid_constant__ FusedCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  FusedRunner<T, Touching, Loose, Kind, Near> runner(call, shared);
  const int team = Kind != Blocks::one ? int(blockIdx.x) / call.step.plan.patches : int(blockIdx.x);
  for (std::int64_t e = team; e < call.step.batch; e += call.teams) runner.roll(e);
  // nobody leaves while others may still write to its shared memory
  if constexpr (Kind == Blocks::cluster) cluster_barrier();
}

template <class T>
using FusedKernel = void (*)(FusedCall<T>);

template <class T, bool Touching, bool Loose>
FusedKernel<T> fused_kernel_for(Blocks kind, bool near, int threads) {
  constexpr int most = most_grid_threads<T>;
  if (kind == Blocks::cluster) {
    constexpr int few = most * 5 / 8;  // have more registers each
    if (threads <= few) {
      if (near) return fused_step<T, Touching, Loose, Blocks::cluster, true, few>;
      return fused_step<T, Touching, Loose, Blocks::cluster, false, few>;
    }
    if (near) return fused_step<T, Touching, Loose, Blocks::cluster, true, most>;
    return fused_step<T, Touching, Loose, Blocks::cluster, false, most>;
  }
  if (kind == Blocks::grid) {
    if (near) return fused_step<T, Touching, Loose, Blocks::grid, true, most>;
    return fused_step<T, Touching, Loose, Blocks::grid, false, far_threads<T>>;
  }
  if (near) return fused_step<T, Touching, Loose, Blocks::one, true, resident_threads<T>>;
  return fused_step<T, Touching, Loose, Blocks::one, false, resident_threads<T>>;
}

}  // namespace pd
