// Runs solver/adjoint/conjugate_gradients.h after the launch that computes the weights.
#pragma once
#include "cuda/adjoint/launch.cuh"
#include "cuda/adjoint/one_block.cuh"

namespace pd::inline PD_TARGET {

template <class T>
bool fits_one_block(const DeviceConjugate<T>& call) {
  return call.plan.kernel == int(DeviceKernel::block);
}

template <class T>
std::int64_t conjugate_bytes(const DeviceConjugate<T>& call) {
  Arena arena(nullptr);
  if (fits_one_block(call)) {
    arrange_block(arena, call);
  } else {
    arrange_teams(arena, call, ConjugateLaunch<T>(call));
  }
  return arena.size();
}

template <class T>
void run_conjugate(const DeviceConjugate<T>& call, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  fits_one_block(call) ? run_conjugate_block(call, memory, stream)
                       : run_conjugate_teams(call, memory, stream);
}

}  // namespace pd::inline PD_TARGET
