// Conjugate gradients of a step with contact between bodies, by teams of blocks.
#pragma once
#include "cuda/adjoint/mixed_conjugate.cuh"

namespace pd::inline PD_TARGET {

template <class Work, class T>
ConjugateLaunch<T> contact_launch(const MixedConjugate<T>& call, int items) {
  return {call, reinterpret_cast<const void*>(conjugate_teams<Work, false, true, true>), items,
          most_teams(*call.pairs)};
}

// Calls run(work, launch) with the memory of `arena`, for a scene with stencils or without.
template <class T, class Run>
void with_contact(Arena& arena, const MixedConjugate<T>& call, const Run& run) {
  const auto arrange = [&](auto work, const ConjugateLaunch<T>& launch) {
    static_cast<ConjugateTeams<T>&>(work) =
        arrange_teams(arena, static_cast<const DeviceConjugate<T>&>(call), launch);
    work.pairs = *call.pairs;
    work.arena.stride = bytes_of_pairs(work.pairs);
    arena.place(work.arena.memory, launch.teams.count * work.arena.stride);
    if constexpr (decltype(work)::has_stencils) work.stencils = arrange_stencils(arena, call);
    run(work, launch);
  };
  if (call.stencils.blocks > 0) {
    using Work = WithPairs<MixedConjugateTeams<T>>;
    arrange(Work{}, contact_launch<Work>(call, items_of_patch(call)));
  } else {
    using Work = WithPairs<ConjugateTeams<T>>;
    arrange(Work{}, contact_launch<Work>(call, call.plan.most_pairs));
  }
}

template <class T>
std::int64_t contact_conjugate_bytes(const MixedConjugate<T>& call) {
  Arena arena(nullptr);
  with_contact(arena, call, [](const auto&, const auto&) {});
  return arena.size();
}

template <class T>
void run_contact_conjugate(const MixedConjugate<T>& call, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  Arena arena(memory);
  with_contact(arena, call, [&](auto& work, const ConjugateLaunch<T>& launch) {
    if constexpr (std::remove_reference_t<decltype(work)>::has_stencils)
      compute_numbers(work.stencils, call, stream);
    compute_field_weights<true, T>(work.product, stream);
    launch_solve(launch, work, stream);
  });
}

}  // namespace pd::inline PD_TARGET
