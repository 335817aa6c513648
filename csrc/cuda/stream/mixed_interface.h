// Passes over scenes with stencils, for StreamRunner. They replace stream_patches and stream_weights.
#pragma once
#include "cuda/common/stencil_numbers.h"
#include "cuda/stream/kernels.h"

#include <cuda_runtime.h>

namespace pd::inline PD_TARGET {

template <class T>
struct MixedStreamCall : StreamCall<T> {
  StencilWork<T> stencils;
};

// Raises the shared memory limit of the passes to `bytes`.
template <class T, bool HasContacts>
void allow_mixed_passes(std::size_t bytes);

// Updates the elements and interior vertices of `patches` patches, of all environments.
template <class T, bool HasContacts>
void run_mixed_pass(Visit what, const MixedStreamCall<T>& call, std::int64_t patches,
                    std::size_t shared, int k, cudaStream_t stream);

// Makes the memory of the stencils of all environments from the origins of a step, if there is any.
template <class T>
void run_mixed_begin(const MixedStreamCall<T>& call, std::int64_t patches, cudaStream_t stream);

// w V of the tetrahedra of `patches` patches.
template <class T>
void run_mixed_weights(const StreamCall<T>& call, std::int64_t patches, WeightKind kind,
                       cudaStream_t stream);

}  // namespace pd::inline PD_TARGET
