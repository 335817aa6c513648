// The numbers of a step of all stencils, computed once a call from the rows of the material.
#pragma once
#include "cuda/common/arena.h"
#include "cuda/elements/stencils.h"

#include <cuda_runtime.h>

namespace pd::inline PD_TARGET {

// Places the numbers: of every environment, or one set where all share their rows.
template <class T>
StencilWork<T> arrange_stencils(Arena& arena, const DeviceStencils<T>& plan,
                                const Effects<T>& effects, std::int64_t batch) {
  StencilWork<T> work{plan};
  const std::int64_t numbers = std::int64_t(plan.number_rows) * stencil_lanes;
  work.stride = shares_effects(effects) ? 0 : numbers;
  arena.place(work.numbers, (work.stride ? batch : 1) * numbers);
  return work;
}

// The same for a step, with the numbers of its rows.
template <class T>
StencilWork<T> arrange_step_stencils(Arena& arena, const DeviceStencils<T>& plan,
                                     const Effects<T>& effects, std::int64_t batch) {
  StencilWork<T> work = arrange_stencils(arena, plan, effects, batch);
  if (!plan.has_rows()) return work;
  work.row_stride = work.stride ? plan.numbers_of_rows() : 0;
  arena.place(work.rows, (work.stride ? batch : 1) * plan.numbers_of_rows());
  return work;
}

template <class T>
void compute_stencil_numbers(const StencilWork<T>& work, const Effects<T>& effects,
                             std::int64_t batch, cudaStream_t stream);
// after compute_stencil_numbers
template <class T>
void compute_row_numbers(const StencilWork<T>& work, std::int64_t batch, cudaStream_t stream);

}  // namespace pd::inline PD_TARGET
