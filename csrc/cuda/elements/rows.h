// Quadratic stencils of a patch in a step, as rows of a matrix (views/gpu_step_rows.def): a warp takes a block of 32 vertices.
//
//   force on v = sum_u t_vu (x_u - x_v),   E = -1/4 sum_v sum_u t_vu |x_u - x_v|^2
//
// t has both signs, so the energy of a smooth surface is small against its terms. Differences and sums of the energy are
// float64: the rounding of x_u - x_v in float32 would change it by more than the slack of the guard.
#pragma once
#include "cuda/elements/stencils.h"

namespace pd::inline PD_TARGET {

constexpr int row_lanes = 32;  // vertices per block of the plan

// Two numbers t of a lane.
template <class T>
struct alignas(2 * sizeof(T)) RowPair {
  T first, second;
};

// The rows of one environment.
template <class T>
struct Rows {
  const DeviceStencils<T>& plan;
  const T* numbers;

  PD_DEVICE RowPair<T> pair(int line) const {
    return reinterpret_cast<const RowPair<T>*>(numbers)[line * row_lanes + int(threadIdx.x) % 32];
  }
  // of the majoriser if `bounded`, else of the stiffness at rest
  PD_DEVICE T diagonal(int block, bool bounded) const {
    const std::int64_t before =
        2 * std::int64_t(plan.rows[row_lines]) + (bounded ? plan.rows[row_blocks] : 0) + block;
    return numbers[before * row_lanes + int(threadIdx.x) % 32];
  }
};

// The force on this lane's vertex.
template <bool Energy, class T, class Read>
PD_DEVICE Vec3<T> value_of_row(const StencilGradient<Energy>&, const Rows<T>& rows, int block,
                               unsigned corner, const Read& read, double& energy) {
  const int end = rows.plan.row_start[block + 1];
  const auto at = [&](unsigned slot_times_8) {
    Vec3<T> x[1];
    read(slot_times_8, x);
    return x[0];
  };
  const Vec3<T> own = at(corner & 0xffff);
  Vec3<T> force = {T(0), T(0), T(0)};
#pragma unroll 4
  for (int line = rows.plan.row_start[block]; line < end; ++line) {
    const auto both = unsigned(rows.plan.row_neighbour[line * row_lanes + int(threadIdx.x) % 32]);
    const RowPair<T> t = rows.pair(line);
    const Vec3<T> one = at(both & 0xffff), two = at(both >> 16);
    force = multiply_add(t.second, two - own, multiply_add(t.first, one - own, force));
    if constexpr (Energy) {
      const auto square = [&own](const Vec3<T>& x) {
        const double d[3] = {double(x.x) - double(own.x), double(x.y) - double(own.y),
                             double(x.z) - double(own.z)};
        return d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
      };
      energy -= 0.25 * (double(t.first) * square(one) + double(t.second) * square(two));
    }
  }
  return force;
}

template <class T, class Read>
PD_DEVICE Vec3<T> value_of_row(const StencilDiagonal& diagonal, const Rows<T>& rows, int block,
                               unsigned, const Read&, double&) {
  const T entry = rows.diagonal(block, diagonal.bounded);
  return {entry, entry, entry};
}

// Applies an operation to the rows of a patch; returns this thread's energy sum. `before`: blocks that warps have taken
// in turn before these.
template <class T, class Read, class Element>
PD_DEVICE double each_row(const StencilWork<T>& work, std::int64_t environment, int patch,
                          int before, const Read& read, Quad<T>* entries, const Element& element) {
  double energy = 0;
  if (!work.plan.has_rows()) return energy;
  const Rows<T> rows{work.plan, work.rows + environment * work.row_stride};
  const int warps = int(blockDim.x) / row_lanes;
  int turn = int(threadIdx.x) / row_lanes - before % warps;
  if (turn < 0) turn += warps;
  const int end = work.plan.patch_row[patch + 1];
#pragma unroll 1
  for (int block = work.plan.patch_row[patch] + turn; block < end; block += warps) {
    const auto corner = unsigned(work.plan.row_corner[block * row_lanes + int(threadIdx.x) % 32]);
    const Vec3<T> value = value_of_row(element, rows, block, corner, read, energy);
    if (corner >> 16 != unsigned(no_entry)) write_entry(value, entries[corner >> 16]);
  }
  return energy;
}

// The stencils of a patch in a step: those that are elements, then the rows. Returns this thread's energy sum.
template <class T, class Read, class Element>
PD_DEVICE double each_stencil_of_step(const StencilWork<T>& work, std::int64_t environment,
                                      int patch, int before, const Read& read, Quad<T>* entries,
                                      const Element& element) {
  const double energy =
      double(each_stencil<1>(work, environment, patch, before, read, entries, element));
  const int elements = work.plan.stencil_end[patch] - work.plan.patch_stencil[patch];
  return energy + each_row(work, environment, patch, before + elements, read, entries, element);
}

// Prefetches what the rows of a patch read, but for that of the last block, into the L2 cache.
template <class T>
PD_DEVICE void prefetch_rows(const StencilWork<T>& work, std::int64_t environment, int patch) {
  const DeviceStencils<T>& plan = work.plan;
  if (!plan.has_rows()) return;
  const int first = plan.patch_row[patch], last = plan.patch_row[patch + 1] - 1;
  if (first >= last) return;
  const int begin = plan.row_start[first], lines = plan.row_start[last] - begin;
  const T* const t = work.rows + environment * work.row_stride;
  const int thread = int(threadIdx.x), threads = int(blockDim.x);
  const auto number = [&](int warp) { return (thread + threads - warp * warp_size) % threads; };
  bulk_prefetch_to_l2(plan.row_neighbour + std::size_t(begin) * row_lanes, lines * row_lanes,
                      number(3), threads);
  bulk_prefetch_to_l2(t + std::size_t(2 * begin) * row_lanes, 2 * lines * row_lanes, number(4),
                      threads);
}

}  // namespace pd::inline PD_TARGET
