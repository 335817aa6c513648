// The numbers of a step of all stencils, computed once a call from the rows of the material.
#pragma once
#include "cuda/elements/stencils.h"
#include "views/arena.h"

#include <cuda_runtime.h>

namespace pd::inline PD_TARGET {

// Places the numbers: of every environment, or one set where all share their rows and none has a memory. `per_time`: 1 / h
// where energies that dissipate count, else 0.
template <class T>
StencilWork<T> arrange_stencils(Arena& arena, const DeviceStencils<T>& plan,
                                const Effects<T>& effects, std::int64_t batch, T per_time) {
  StencilWork<T> work{plan};
  const std::int64_t numbers = std::int64_t(plan.number_rows) * stencil_lanes;
  const bool own = !shares_effects(effects) || plan.remembers ||
                   (plan.reads_tets && effects.stiffness.stride != 0);
  work.stride = own ? numbers : 0;
  work.per_time = per_time;
  arena.place(work.numbers, (work.stride ? batch : 1) * numbers);
  return work;
}

// The same for a step, with the numbers of its rows.
template <class T>
StencilWork<T> arrange_step_stencils(Arena& arena, const DeviceStencils<T>& plan,
                                     const Effects<T>& effects, std::int64_t batch, T per_time) {
  StencilWork<T> work = arrange_stencils(arena, plan, effects, batch, per_time);
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

// Makes the memory of all stencils from positions [batch, vertices, 3] by the user's numbers, if there is any.
template <class T>
void begin_stencils(const StencilWork<T>& work, const DevicePlan<T>& plan, const T* positions,
                    std::int64_t batch, cudaStream_t stream);

}  // namespace pd::inline PD_TARGET
