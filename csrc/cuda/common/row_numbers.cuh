// The numbers of the rows of quadratic stencils: sums of their terms, from the numbers of a step of the stencils.
#pragma once
#include "cuda/common/runtime.h"
#include "cuda/common/stencil_numbers.h"

namespace pd::inline PD_TARGET {

constexpr int row_number_threads = 256;

// A stencil of the plan, by its number counted by blocks.
template <class T>
struct TermStencil {
  const DeviceStencils<T>& plan;
  int number, lane;
  StencilBlock block;

  PD_DEVICE TermStencil(const DeviceStencils<T>& stencils, int stencil)
      : plan(stencils),
        number(stencil),
        lane(stencil % stencil_lanes),
        block(StencilPlace<T>::block_of(stencils, stencil / stencil_lanes)) {}

  PD_DEVICE T stored(int which) const {
    return plan.stencil_stored[std::size_t(block.stored + which) * stencil_lanes + lane];
  }
  // g of a corner, d = 1
  PD_DEVICE T gradient(int corner) const {
    if (corner > 0) return stored(corner - 1);
    T sum = T(0);
    with_compiled_kind(block.kind, [&](auto kind) {
      for (int i = 0; i < decltype(kind)::corners - 1; ++i) sum = sum + stored(i);
    });
    return -sum;
  }
  PD_DEVICE T weight(const T* numbers) const {
    return numbers[std::size_t(block.number) * stencil_lanes + lane];
  }
};

// One thread per number and environment: t of the neighbours, then the diagonals. Those are minus infinity where the
// material is negative, as in StencilDiagonal.
template <class T>
__global__ void __launch_bounds__(row_number_threads)
    row_numbers(const __grid_constant__ StencilWork<T> work, std::int64_t sets) {
  const DeviceStencils<T>& plan = work.plan;
  const std::int64_t diagonals = std::int64_t(plan.rows[row_blocks]) * stencil_lanes;
  const std::int64_t neighbours = 2 * std::int64_t(plan.rows[row_lines]) * stencil_lanes;
  const std::int64_t thread = std::int64_t(blockIdx.x) * row_number_threads + threadIdx.x;
  const std::int64_t environment = thread / (neighbours + diagonals);
  if (environment >= sets) return;
  const std::int64_t number = thread % (neighbours + diagonals);
  const T* const of_step = work.numbers_of(environment);
  T* const to = work.rows + environment * work.row_stride + number;
  T sum = T(0), bounded = T(0);
  for (int i = plan.term_start[number]; i < plan.term_start[number + 1]; ++i) {
    const int term = plan.row_term[i], corners = term % 32;
    const TermStencil<T> stencil(plan, term / 32);
    const T weight = stencil.weight(of_step);
    T product = weight * (stencil.gradient(corners / 5) * stencil.gradient(corners % 5));
    if (number >= neighbours && weight < T(0)) product = -T(HUGE_VAL);
    sum = sum + product;
    if (number >= neighbours) bounded = bounded + product * plan.stencil_bound[stencil.number];
  }
  *to = sum;
  if (number >= neighbours) to[diagonals] = bounded;
}

template <class T>
void compute_row_numbers(const StencilWork<T>& work, std::int64_t batch, cudaStream_t stream) {
  if (!work.plan.has_rows()) return;
  const std::int64_t sets = work.row_stride ? batch : 1;
  const std::int64_t each =
      work.plan.numbers_of_rows() - work.plan.rows[row_blocks] * stencil_lanes;
  row_numbers<T><<<blocks_of((sets * each + row_number_threads - 1) / row_number_threads),
                   row_number_threads, 0, stream>>>(work, sets);
  check(cudaGetLastError());
}

template void compute_row_numbers(const StencilWork<float>&, std::int64_t, cudaStream_t);
template void compute_row_numbers(const StencilWork<double>&, std::int64_t, cudaStream_t);

}  // namespace pd::inline PD_TARGET
