// Kernels of cuda/stream/mixed_interface.h.
#pragma once
#include "cuda/common/runtime.h"
#include "cuda/stream/mixed_interface.h"

namespace pd::inline PD_TARGET {

template <Visit What, class T, bool HasContacts>
__global__ void __launch_bounds__(pass_threads, sizeof(T) == 4 ? 2 : 1)
    mixed_patches(const __grid_constant__ MixedStreamCall<T> call, int k) {
  extern __shared__ __align__(16) std::byte shared[];
  update_patch<What, T, HasContacts>(call, k, shared,
                                     StencilsOfPass<T>{call.stencils, call.step.settings.weighted});
}

template <class T>
__global__ void __launch_bounds__(vertex_threads)
    mixed_begin(const __grid_constant__ MixedStreamCall<T> call) {
  const StreamWork<T, false> w(call, blockIdx.x / call.step.plan.patches);
  const Patch<T> patch(w.plan, int(blockIdx.x % call.step.plan.patches));
  const Quad<T>* const origin = w.origin + patch.first_slot;
  begin_stencils(call.stencils, w.environment, patch.index, 0,
                 [origin](unsigned corner, Vec3<T>(&x)[1]) { x[0] = at_corner(origin, corner); });
}

template <class T>
__global__ void __launch_bounds__(vertex_threads)
    mixed_weights(const __grid_constant__ StreamCall<T> call, WeightKind kind) {
  const StreamWork<T, false> w(call, blockIdx.x / call.step.plan.patches);
  const Patch<T> patch(w.plan, int(blockIdx.x % call.step.plan.patches));
  const Moduli<T> moduli(call.step.material.stiffness, call.step.poisson, w.environment);
  compute_patch_weights(patch, rest_of<true>(patch), moduli, kind, w.weights);
}

template <class T, bool HasContacts>
void (*mixed_pass(Visit what))(MixedStreamCall<T>, int) {
  switch (what) {
    case Visit::diagonal:
      return mixed_patches<Visit::diagonal, T, HasContacts>;
    case Visit::update:
      return mixed_patches<Visit::update, T, HasContacts>;
    case Visit::keep_forces:
      return mixed_patches<Visit::keep_forces, T, HasContacts>;
    default:
      return mixed_patches<Visit::update_guarded, T, HasContacts>;
  }
}

template <class T, bool HasContacts>
void allow_mixed_passes(std::size_t bytes) {
  for (const Visit what :
       {Visit::diagonal, Visit::update, Visit::update_guarded, Visit::keep_forces}) {
    const auto* kernel = reinterpret_cast<const void*>(mixed_pass<T, HasContacts>(what));
    if (resident_blocks(kernel, pass_threads, bytes) == 0) refuse_shared_memory(bytes);
  }
}

template <class T, bool HasContacts>
void run_mixed_pass(Visit what, const MixedStreamCall<T>& call, std::int64_t patches,
                    std::size_t shared, int k, cudaStream_t stream) {
  mixed_pass<T, HasContacts>(what)<<<blocks_of(patches), pass_threads, shared, stream>>>(call, k);
  check(cudaGetLastError());
}

template <class T>
void run_mixed_begin(const MixedStreamCall<T>& call, std::int64_t patches, cudaStream_t stream) {
  // no other kind has a memory
  if constexpr (has_large_kinds) {
    if (!call.stencils.plan.remembers) return;
    mixed_begin<T><<<blocks_of(patches), vertex_threads, 0, stream>>>(call);
    check(cudaGetLastError());
  }
}

template <class T>
void run_mixed_weights(const StreamCall<T>& call, std::int64_t patches, WeightKind kind,
                       cudaStream_t stream) {
  mixed_weights<T><<<blocks_of(patches), vertex_threads, 0, stream>>>(call, kind);
  check(cudaGetLastError());
}

}  // namespace pd::inline PD_TARGET
