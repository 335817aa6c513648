// The iterations of the multilevel solver as functions, for the runner of a step.
#pragma once
#include "cuda/stream.h"

#include <cuda_runtime.h>

namespace pd {

// Bytes of device memory beside those of a step, aligned to 256.
template <class T>
std::int64_t outer_bytes(const DeviceStep<T>& step);

// Compares the material of a step with that of its preconditioner; once a call, after the weights.
template <class T>
void run_comparison(const StreamCall<T>& call, void* memory, cudaStream_t stream);

// multilevel_iterations of every environment.
template <class T>
void run_outer(const StreamCall<T>& call, void* memory, cudaStream_t stream);

}  // namespace pd
