#include "cuda/common/stencil_numbers.h"

#include "cuda/common/row_numbers.cuh"
#include "cuda/common/runtime.h"

namespace pd::inline PD_TARGET {

constexpr int number_threads = 256;

// One warp per block of stencils and environment.
template <class T>
__global__ void __launch_bounds__(number_threads)
    stencil_numbers(const __grid_constant__ StencilWork<T> work,
                    const __grid_constant__ Effects<T> effects, std::int64_t sets) {
  const std::int64_t warp =
      (std::int64_t(blockIdx.x) * number_threads + threadIdx.x) / stencil_lanes;
  if (warp >= sets * work.plan.blocks) return;
  const std::int64_t environment = warp / work.plan.blocks;
  const StencilPlace<T> place(work.plan, int(warp % work.plan.blocks));
  T* const to = work.numbers_of(environment);
  with_compiled_kind(place.block.kind, [&](auto kind) {
    using Kind = decltype(kind);
    T number[Kind::numbers], measure = work.plan.stencil_measure[place.stencil()];
    if (dissipates<Kind>) measure = measure * work.per_time;
    const MaterialRows<Kind, T> rows(effects, environment);
    rows.read(work.plan.stencil_row[place.stencil()], measure, number);
    for (int i = 0; i < Kind::numbers - memory_of<Kind>; ++i)
      to[place.number_of_step(i)] = number[i];
  });
}

// One block per patch and environment.
template <class T>
__global__ void __launch_bounds__(number_threads)
    stencil_memory(const __grid_constant__ StencilWork<T> work,
                   const __grid_constant__ DevicePlan<T> plan, const T* positions) {
  const std::int64_t environment = blockIdx.x / plan.patches;
  const Patch<T> patch(plan, int(blockIdx.x % plan.patches));
  const auto at = [&](int slot) {
    const std::int64_t vertex = plan.vertex_order[patch.vertex(slot)];
    return read3(positions + 3 * (environment * plan.vertices + vertex));
  };
  const Vec3<T> anchor = at(0);
  begin_stencils(work, environment, patch.index, 0, [&](unsigned corner, Vec3<T>(&x)[1]) {
    x[0] = at(int((corner & 0xffff) / 8)) - anchor;
  });
}

template <class T>
void compute_stencil_numbers(const StencilWork<T>& work, const Effects<T>& effects,
                             std::int64_t batch, cudaStream_t stream) {
  const std::int64_t sets = work.stride ? batch : 1;
  const std::int64_t threads = sets * work.plan.blocks * stencil_lanes;
  stencil_numbers<T>
      <<<blocks_of((threads + number_threads - 1) / number_threads), number_threads, 0, stream>>>(
          work, effects, sets);
  check(cudaGetLastError());
}

template <class T>
void begin_stencils(const StencilWork<T>& work, const DevicePlan<T>& plan, const T* positions,
                    std::int64_t batch, cudaStream_t stream) {
  // no other kind has a memory
  if constexpr (has_large_kinds) {
    if (!work.plan.remembers || !(work.per_time > T(0))) return;
    stencil_memory<T>
        <<<blocks_of(batch * plan.patches), number_threads, 0, stream>>>(work, plan, positions);
    check(cudaGetLastError());
  }
}

template void compute_stencil_numbers(const StencilWork<float>&, const Effects<float>&,
                                      std::int64_t, cudaStream_t);
template void compute_stencil_numbers(const StencilWork<double>&, const Effects<double>&,
                                      std::int64_t, cudaStream_t);
template void begin_stencils(const StencilWork<float>&, const DevicePlan<float>&, const float*,
                             std::int64_t, cudaStream_t);
template void begin_stencils(const StencilWork<double>&, const DevicePlan<double>&, const double*,
                             std::int64_t, cudaStream_t);

}  // namespace pd::inline PD_TARGET
