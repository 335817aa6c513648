// Launch of kernel block for scenes with stencils, in one precision.
#pragma once
#include "cuda/common/stencil_numbers.h"
#include "cuda/fused/launch.cuh"
#include "cuda/fused/mixed_kernels.cuh"

namespace pd::inline PD_TARGET {

// instantiated in mixed_contacts_float.cu and mixed_contacts_double.cu
extern template MixedKernel<float> mixed_kernel_for<float, true, true>(bool);
extern template MixedKernel<double> mixed_kernel_for<double, true, true>(bool);

template <class T>
MixedKernel<T> mixed_kernel(const MixedStep<T>& step, bool in_shared) {
  if (has_contacts(step)) return mixed_kernel_for<T, true, true>(in_shared);
  // fewer kernels with Poisson's ratio
  if constexpr (has_poisson_ratio)
    return has_free_pieces(step) ? mixed_kernel_for<T, true, true>(in_shared)
                                 : mixed_kernel_for<T, false, false>(in_shared);
  return has_free_pieces(step) ? mixed_kernel_for<T, false, true>(in_shared)
                               : mixed_kernel_for<T, false, false>(in_shared);
}

// Launch configuration of a call. A warp takes 32 pairs of tetrahedra, 32 stencils or 32 rows at a time.
template <class T>
struct MixedLaunch {
  static constexpr Blocks kind = Blocks::one;
  static constexpr int patches = 1;
  MixedKernel<T> kernel;
  int threads, teams, kept;
  std::size_t shared;

  explicit MixedLaunch(const MixedStep<T>& step) {
    const int pairs = (step.plan.most_pairs + pair_lanes - 1) / pair_lanes * pair_lanes;
    const DeviceStencils<T>& stencils = step.stencils;
    const int others = stencils.has_rows()
                           ? stencils.rows[row_step_stencils] + stencils.rows[row_blocks]
                           : stencils.blocks;
    const BlockForm form(step, pairs + others * stencil_lanes);
    threads = form.threads;
    kept = form.kept;
    shared = form.shared;
    kernel = mixed_kernel(step, form.in_shared());
    const int resident = resident_blocks(function(), threads, shared);
    if (resident == 0) refuse_shared_memory(shared);
    teams = int(std::min<std::int64_t>(step.batch, resident));
  }

  const void* function() const { return reinterpret_cast<const void*>(kernel); }
};

template <class T>
MixedFusedCall<T> arrange_mixed(Arena& arena, const MixedStep<T>& step,
                                const MixedLaunch<T>& launch) {
  const DeviceStep<T>& call = step;
  const FusedScratch<T> scratch = arrange(arena, call, launch);
  return {{call, scratch, launch.teams, launch.kept},
          arrange_step_stencils(arena, step.stencils, step.effects, step.batch,
                                T(1 / step.settings.time_step))};
}

template <class T>
std::int64_t mixed_block_bytes(const MixedStep<T>& given) {
  const MixedStep<T> step = with_rows(given);
  Arena arena(nullptr);
  arrange_mixed(arena, step, MixedLaunch<T>(step));
  return arena.size();
}

template <class T>
void run_mixed_block(const MixedStep<T>& given, void* memory, Stream to) {
  const MixedStep<T> step = with_rows(given);
  const auto stream = static_cast<cudaStream_t>(to);
  const MixedLaunch<T> launch(step);
  Arena arena(memory);
  MixedFusedCall<T> call = arrange_mixed(arena, step, launch);
  compute_stencil_numbers(call.stencils, step.effects, step.batch, stream);
  compute_row_numbers(call.stencils, step.batch, stream);
  void* arguments[] = {&call};
  check(cudaLaunchKernel(launch.function(), dim3(unsigned(launch.teams)), dim3(launch.threads),
                         arguments, launch.shared, stream));
}

}  // namespace pd::inline PD_TARGET
