// Entry points of the multilevel solver's iterations, for StreamRunner.
#pragma once
#include "cuda/stream/kernels.h"

#include <cuda_runtime.h>

namespace pd::inline PD_TARGET {

// Device memory in bytes beside that of a step, aligned to 256.
template <class T>
std::int64_t multilevel_bytes(const DeviceStep<T>& step);

// Compares a step's material with that of its preconditioner; called once per call, after the
// weights.
template <class T>
void run_material_comparison(const StreamCall<T>& call, void* memory, cudaStream_t stream);

// Runs multilevel_iterations for every environment.
template <class T>
void run_multilevel(const StreamCall<T>& call, void* memory, cudaStream_t stream);

}  // namespace pd::inline PD_TARGET
