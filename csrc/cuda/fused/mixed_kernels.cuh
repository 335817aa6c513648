// The fused kernel of scenes with stencils: one block per environment.
#pragma once
#include "cuda/fused/kernels.cuh"

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, bool HasFreePieces, bool InShared>
__global__ void __launch_bounds__(resident_threads<T>, 1)
    mixed_step(const __grid_constant__ MixedFusedCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  FusedRunner<T, HasContacts, HasFreePieces, Blocks::one, InShared, true> runner(call, shared);
  for (std::int64_t e = blockIdx.x; e < call.step.batch; e += call.teams) runner.rollout(e);
}

template <class T>
using MixedKernel = void (*)(MixedFusedCall<T>);

template <class T, bool HasContacts, bool HasFreePieces>
MixedKernel<T> mixed_kernel_for(bool in_shared) {
  return in_shared ? mixed_step<T, HasContacts, HasFreePieces, true>
                   : mixed_step<T, HasContacts, HasFreePieces, false>;
}

}  // namespace pd::inline PD_TARGET
