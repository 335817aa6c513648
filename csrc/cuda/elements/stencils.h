// Stencils of a patch in a thread block, beside its pairs of tetrahedra: a warp takes a block of 32 stencils of one kind.
// Corners write their forces to entries of their own, like those of pairs (cuda/elements/pairs_per_thread.h).
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/elements/pairs_per_thread.h"
#include "elements/kinds.h"

namespace pd::inline PD_TARGET {

constexpr int stencil_lanes = 32;  // stencils per block of the plan

// Large kinds would take registers from all others: only the kernels for Poisson's ratio have them.
constexpr bool has_large_kinds = has_poisson_ratio;
template <class Kind>
constexpr bool is_compiled = runs_on_gpu<Kind> && (has_large_kinds || !is_large<Kind>);

// The stencils of a plan, and their numbers of a step.
template <class T>
struct StencilWork {
  DeviceStencils<T> plan;
  T* numbers = nullptr;     // [batch or 1, rows of 32]
  std::int64_t stride = 0;  // from one environment to the next
  T* rows = nullptr;        // [batch or 1, numbers_of_rows] of a step
  std::int64_t row_stride = 0;
  T per_time = T(0);  // 1 / h, or 0 where energies that dissipate do not count

  PD_HD T* numbers_of(std::int64_t environment) const { return numbers + environment * stride; }
};

// A row of stencil_block.
struct alignas(16) StencilBlock {
  int32 kind, corner, stored, number;
};

// A lane of a block.
template <class T>
struct StencilPlace {
  const DeviceStencils<T>& plan;
  StencilBlock block;
  int number;  // of the block

  PD_DEVICE StencilPlace(const DeviceStencils<T>& stencils, int block_number)
      : StencilPlace(stencils, block_of(stencils, block_number), block_number) {}
  PD_DEVICE StencilPlace(const DeviceStencils<T>& stencils, const StencilBlock& loaded,
                         int block_number)
      : plan(stencils), block(loaded), number(block_number) {}

  PD_DEVICE static StencilBlock block_of(const DeviceStencils<T>& stencils, int block_number) {
    return reinterpret_cast<const StencilBlock*>(stencils.stencil_block)[block_number];
  }

  PD_DEVICE std::size_t row(int first, int which) const {
    return std::size_t(first + which) * stencil_lanes + threadIdx.x % stencil_lanes;
  }
  PD_DEVICE std::size_t stencil() const { return row(number, 0); }
  PD_DEVICE unsigned corner(int c) const {
    return unsigned(plan.stencil_corner[row(block.corner, c)]);
  }
  PD_DEVICE T stored(int which) const { return plan.stencil_stored[row(block.stored, which)]; }
  PD_DEVICE std::size_t number_of_step(int which) const { return row(block.number, which); }
};

// The stencil that an operation works on, see elements/stencil.h: one per lane. `Read` is as in process_pair.
template <class Kind, int Fields, class T, class Read>
struct LaneStencil {
  using R = T;
  const StencilPlace<T>& place;
  T* numbers;
  const Read& read;
  Quad<T>* entries;
  T& energy;
  unsigned word[Kind::corners];

  PD_DEVICE LaneStencil(const StencilPlace<T>& at, T* of_step, const Read& reader, Quad<T>* to,
                        T& sum_of_energies)
      : place(at), numbers(of_step), read(reader), entries(to), energy(sum_of_energies) {
    for (int c = 0; c < Kind::corners; ++c) word[c] = at.corner(c);
  }

  PD_DEVICE void corners(int field, Vec3<T> (&x)[Kind::corners]) const {
    for (int c = 0; c < Kind::corners; ++c) {
      Vec3<T> vectors[Fields];
      read(word[c], vectors);
      x[c] = vectors[field];
    }
  }
  PD_DEVICE T stored(int which) const { return place.stored(which); }
  PD_DEVICE T number(int which) const { return numbers[place.number_of_step(which)]; }
  PD_DEVICE void remember(const T (&memory)[memory_of<Kind>]) const
    requires(memory_of<Kind> > 0)
  {
    for (int i = 0; i < memory_of<Kind>; ++i)
      numbers[place.number_of_step(Kind::numbers - memory_of<Kind> + i)] = memory[i];
  }
  PD_DEVICE T bound() const { return place.plan.stencil_bound[place.stencil()]; }
  PD_DEVICE T& sum() const { return energy; }
  PD_DEVICE void add(const Vec3<T> (&force)[Kind::corners]) const {
    for (int c = 0; c < Kind::corners; ++c) {
      const unsigned entry = word[c] >> 16;
      if (entry != unsigned(no_entry)) write_entry(force[c], entries[entry]);
    }
  }
};

// visit(Kind{}) for the kind of a number; other plans run in other kernels
template <class Visit>
PD_DEVICE void with_compiled_kind(int number, const Visit& visit) {
  with_kind(number, [&](auto kind) {
    if constexpr (is_compiled<decltype(kind)>) visit(kind);
  });
}

// An operation on a stencil of a large kind, apart: the other kinds keep their registers. Returns the energy. What it
// gets must not refer to what the caller has in registers.
template <class Kind, int Fields, class T, class Read, class Element>
__device__ __noinline__ T run_apart(StencilPlace<T> place, T* numbers, Read read, Quad<T>* entries,
                                    Element element) {
  T energy = T(0);
  element.template run<Kind>(
      LaneStencil<Kind, Fields, T, Read>(place, numbers, read, entries, energy));
  return energy;
}

// The forces of a stencil that does not count. `entries` may be null.
template <class Kind, class T>
PD_DEVICE void add_none(const StencilPlace<T>& place, Quad<T>* entries) {
  for (int c = 0; c < Kind::corners && entries; ++c) {
    const unsigned entry = place.corner(c) >> 16;
    if (entry != unsigned(no_entry)) write_entry({T(0), T(0), T(0)}, entries[entry]);
  }
}

// Calls visit(kind, place) for every block of a patch that this warp takes. `before`: blocks that warps have taken in
// turn before these.
template <class T, class Visit>
PD_DEVICE void each_stencil_block(const DeviceStencils<T>& plan, int patch, int before,
                                  const Visit& visit) {
  const int warps = int(blockDim.x) / stencil_lanes, warp = int(threadIdx.x) / stencil_lanes;
  int turn = warp - before % warps;
  if (turn < 0) turn += warps;
  const int end = plan.stencil_end[patch];
  int number = plan.patch_stencil[patch] + turn;
  if (number >= end) return;
  StencilBlock now = StencilPlace<T>::block_of(plan, number);
#pragma unroll 1
  for (; number < end; number += warps) {
    // in flight while this warp works on the present one
    const StencilBlock next = StencilPlace<T>::block_of(plan, min(number + warps, end - 1));
    const StencilPlace<T> place(plan, now, number);
    with_compiled_kind(place.block.kind, [&](auto kind) { visit(kind, place); });
    now = next;
  }
}

// Prefetches what the blocks of a patch read, but for that of the last one, into the L2 cache.
template <class T>
PD_DEVICE void prefetch_stencils(const StencilWork<T>& work, std::int64_t environment, int patch) {
  const DeviceStencils<T>& plan = work.plan;
  const int first = plan.patch_stencil[patch], last = plan.stencil_end[patch] - 1;
  if (first >= last) return;
  const StencilBlock from = StencilPlace<T>::block_of(plan, first);
  const StencilBlock to = StencilPlace<T>::block_of(plan, last);
  const auto prefetch = [](const auto* rows, int begin, int end, int warp) {
    bulk_prefetch_to_l2(rows + std::size_t(begin) * stencil_lanes, (end - begin) * stencil_lanes,
                        (int(threadIdx.x) + int(blockDim.x) - warp * warp_size) % int(blockDim.x),
                        int(blockDim.x));
  };
  prefetch(plan.stencil_corner, from.corner, to.corner, 0);
  prefetch(plan.stencil_stored, from.stored, to.stored, 1);
  prefetch(work.numbers_of(environment), from.number, to.number, 2);
}

// Applies an operation to the stencils of a patch; returns this thread's energy sum.
template <int Fields, class T, class Read, class Element>
PD_DEVICE T each_stencil(const StencilWork<T>& work, std::int64_t environment, int patch,
                         int before, const Read& read, Quad<T>* entries, const Element& element) {
  T energy = T(0);
  T* numbers = work.numbers_of(environment);
  each_stencil_block(work.plan, patch, before, [&](auto kind, const StencilPlace<T>& place) {
    using Kind = decltype(kind);
    if constexpr (dissipates<Kind>) {
      if (!(work.per_time > T(0))) return add_none<Kind>(place, entries);
    }
    if constexpr (is_large<Kind>) {
      energy += run_apart<Kind, Fields>(place, numbers, read, entries, element);
    } else {
      element.template run<Kind>(
          LaneStencil<Kind, Fields, T, Read>(place, numbers, read, entries, energy));
    }
  });
  return energy;
}

// Makes the memory of the stencils of a patch. `read` gives the positions at the start of the step.
template <class T, class Read>
PD_DEVICE void begin_stencils(const StencilWork<T>& work, std::int64_t environment, int patch,
                              int before, const Read& read) {
  each_stencil<1>(work, environment, patch, before, read, static_cast<Quad<T>*>(nullptr),
                  StencilBegin{});
}

// The operation on stencils that belongs to one on tetrahedra. `bounded`: weights have l_e.
template <bool Energy>
PD_DEVICE StencilGradient<Energy> on_stencils(const SolidGradient<Energy>& solid, bool) {
  return {solid.wanted};
}
PD_DEVICE StencilDiagonal on_stencils(const SolidDiagonal&, bool bounded) { return {bounded}; }
PD_DEVICE StencilHessian on_stencils(const SolidHessian&, bool) { return {}; }
PD_DEVICE StencilReport on_stencils(const SolidReport&, bool) { return {}; }

// Pairs, then stencils.
template <int Fields, class T, class Read, class Rest, class Element>
PD_DEVICE T each_pair_and_stencil(const Patch<T>& patch, const Read& read, const Rest& rest,
                                  const T* weights, const StencilWork<T>& stencils,
                                  std::int64_t environment, bool bounded, Quad<T>* entries,
                                  const Element& element) {
  T energy = T(0);
  if (patch.pairs > 0) energy = each_pair<Fields>(patch, read, rest, weights, entries, element);
  const int blocks = (patch.pairs + pair_lanes - 1) / pair_lanes;
  return energy + each_stencil<Fields>(stencils, environment, patch.index, blocks, read, entries,
                                       on_stencils(element, bounded));
}

}  // namespace pd::inline PD_TARGET
