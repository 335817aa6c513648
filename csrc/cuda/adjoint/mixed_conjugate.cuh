// Conjugate gradients for scenes with stencils: kernel block in one block, kernel stream by teams.
#pragma once
#include "cuda/adjoint/conjugate_gradients.cuh"
#include "cuda/common/stencil_numbers.h"

namespace pd::inline PD_TARGET {

template <class T>
struct MixedConjugateBlock : ConjugateBlock<T> {
  StencilWork<T> stencils;
};

template <class T>
PD_DEVICE void multiply_elements(const MixedConjugateBlock<T>& work,
                                 const PatchFields<2, T>& fields) {
  each_pair_and_stencil<2>(fields.patch, fields, rest_of<false>(fields.patch),
                           work.product.weights_of(blockIdx.x), work.stencils, blockIdx.x, false,
                           fields.entries, SolidHessian{});
}

template <class T>
struct MixedConjugateTeams : ConjugateTeams<T> {
  static constexpr bool has_stencils = true;
  StencilWork<T> stencils;
};

// Pairs and stencils of a patch, about: a warp takes 32 of either at a time.
template <class T>
int items_of_patch(const MixedConjugate<T>& call) {
  const int blocks = (call.plan.most_pairs + pair_lanes - 1) / pair_lanes;
  return (blocks + (call.stencils.blocks + call.plan.patches - 1) / call.plan.patches) *
         stencil_lanes;
}

template <class T>
ConjugateLaunch<T> mixed_launch(const MixedConjugate<T>& call) {
  using Work = MixedConjugateTeams<T>;
  const auto kernel = call.friction ? conjugate_teams<Work, false, true, true>
                                    : conjugate_teams<Work, false, true, false>;
  return {call, reinterpret_cast<const void*>(kernel), items_of_patch(call)};
}

template <class T>
StencilWork<T> arrange_stencils(Arena& arena, const MixedConjugate<T>& call) {
  return arrange_stencils(arena, call.stencils, call.effects, call.batch, call.per_time);
}

template <class T>
void compute_numbers(const StencilWork<T>& work, const MixedConjugate<T>& call,
                     cudaStream_t stream) {
  compute_stencil_numbers(work, call.effects, call.batch, stream);
  begin_stencils(work, call.plan, call.start, call.batch, stream);
}

template <class T>
std::int64_t mixed_conjugate_bytes(const MixedConjugate<T>& call) {
  const DeviceConjugate<T>& solid = call;
  Arena arena(nullptr);
  if (fits_one_block(solid)) {
    arrange_block(arena, solid);
  } else {
    arrange_teams(arena, solid, mixed_launch(call));
  }
  arrange_stencils(arena, call);
  return arena.size();
}

template <class T>
void run_mixed_conjugate(const MixedConjugate<T>& call, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  const DeviceConjugate<T>& solid = call;
  Arena arena(memory);
  if (fits_one_block(solid)) {
    MixedConjugateBlock<T> work;
    static_cast<ConjugateBlock<T>&>(work) = arrange_block(arena, solid);
    work.stencils = arrange_stencils(arena, call);
    compute_numbers(work.stencils, call, stream);
    compute_field_weights<false, T>(work.product, stream);
    launch_block(work, items_of_patch(call), stream);
    return;
  }
  const ConjugateLaunch<T> launch = mixed_launch(call);
  MixedConjugateTeams<T> work;
  static_cast<ConjugateTeams<T>&>(work) = arrange_teams(arena, solid, launch);
  work.stencils = arrange_stencils(arena, call);
  compute_numbers(work.stencils, call, stream);
  compute_field_weights<true, T>(work.product, stream);
  launch_solve(launch, work, stream);
}

}  // namespace pd::inline PD_TARGET
