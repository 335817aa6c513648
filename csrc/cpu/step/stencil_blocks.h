// Stencils of one patch: reads corners and numbers, adds forces to the patch's slots in a fixed order. The layouts of
// lanes are those of cpu/step/element_blocks.h.
#pragma once
#include "cpu/step/element_blocks.h"
#include "elements/kinds.h"

namespace pd::inline PD_TARGET {

// The lanes of one block of stencils that a pack holds.
template <class T>
struct StencilPart {
  const Plan<T>* plan;
  int block, first_lane;

  PD_HD std::int64_t row(int which, int number) const {
    return (std::int64_t(plan->stencil_block[4 * block + which]) + number) * block_lanes +
           first_lane;
  }
  PD_HD const int16* corner(int c) const { return plan->stencil_corner + row(1, c); }
  PD_HD const T* stored(int number) const { return plan->stencil_stored + row(2, number); }
  PD_HD std::int64_t number(int number) const { return row(3, number); }
  PD_HD std::int64_t stencil() const { return std::int64_t(block) * block_lanes + first_lane; }
};

// The stencils that an operation works on: W of one environment across lanes.
template <class Kind, int Fields, class Lanes>
struct StencilsAcross;
template <class Kind, int Fields, class T>
struct StencilsAcross<Kind, Fields, Single<T>> {
  static constexpr int W = native_width<T>;
  using R = Pack<T, W>;

  StencilPart<T> part;
  const Quad<T>* const (&field)[Fields];
  T* numbers;
  bool shared;
  Quad<T>* forces;
  LaneSums<Single<T>>& sums;

  PD_HD void corners(int f, Vec3<R> (&x)[Kind::corners]) const {
    for (int c = 0; c < Kind::corners; ++c) x[c] = gather_corner<T, W>(field[f], part.corner(c));
  }
  PD_HD R stored(int number) const { return R::load(part.stored(number)); }
  PD_HD R number(int i) const { return R::load(numbers + part.number(i)); }
  PD_HD void remember(const R (&memory)[memory_of<Kind>]) const
    requires(memory_of<Kind> > 0)
  {
    for (int i = 0; i < memory_of<Kind>; ++i)
      memory[i].store(numbers + part.number(Kind::numbers - memory_of<Kind> + i));
  }
  PD_HD R bound() const { return R::load(part.plan->stencil_bound + part.stencil()); }
  PD_HD R& sum() const { return sums.part[part.first_lane / W]; }
  PD_HD void add(const Vec3<R> (&force)[Kind::corners]) const {
    Quad<T> quads[Kind::corners][W];
    for (int c = 0; c < Kind::corners; ++c) store_quads<T, W>(force[c], quads[c]);
    for (int lane = 0; lane < W; ++lane) {
      for (int c = 0; c < Kind::corners; ++c) {
        Quad<T>& to = forces[part.corner(c)[lane]];
        to = to + quads[c][lane];
      }
    }
  }
};

// The same for one stencil of W environments across lanes.
template <class Kind, int Fields, class T, int W>
struct StencilsAcross<Kind, Fields, Batch<T, W>> {
  using R = Pack<T, W>;

  StencilPart<T> part;
  const Vec3<R>* const (&field)[Fields];
  T* numbers;
  bool shared;  // numbers are those of all environments
  Vec3<R>* forces;
  LaneSums<Batch<T, W>>& sums;

  PD_HD void corners(int f, Vec3<R> (&x)[Kind::corners]) const {
    for (int c = 0; c < Kind::corners; ++c) x[c] = field[f][*part.corner(c)];
  }
  PD_HD R stored(int number) const { return R(*part.stored(number)); }
  PD_HD R number(int i) const {
    return shared ? R(numbers[part.number(i)]) : R::load(numbers + part.number(i) * W);
  }
  // not where environments share their numbers
  PD_HD void remember(const R (&memory)[memory_of<Kind>]) const
    requires(memory_of<Kind> > 0)
  {
    for (int i = 0; i < memory_of<Kind>; ++i)
      memory[i].store(numbers + part.number(Kind::numbers - memory_of<Kind> + i) * W);
  }
  PD_HD R bound() const { return R(part.plan->stencil_bound[part.stencil()]); }
  PD_HD R& sum() const { return sums.part[part.first_lane]; }
  PD_HD void add(const Vec3<R> (&force)[Kind::corners]) const {
    for (int c = 0; c < Kind::corners; ++c)
      forces[*part.corner(c)] = forces[*part.corner(c)] + force[c];
  }
};

// visit(w, n) for every stencil of some blocks: its stiffness at rest per measure, and its number after the
// tetrahedra, kind by kind. `per_time`: 1 / h, or 0 where nothing dissipates.
template <class T, class Visit>
void each_stencil_stiffness(const Plan<T>& plan, const Effects<T>& effects,
                            std::int64_t environment, T per_time, std::int64_t begin,
                            std::int64_t end, const Visit& visit) {
  for (std::int64_t b = begin; b < end; ++b) {
    const int number = plan.stencil_block[4 * b];
    std::int64_t first = plan.tets;
    for (int k = 0; k < number; ++k) first += plan.stencil_sizes[stencil_size_count + k];
    with_kind(number, [&](auto kind) {
      using Kind = decltype(kind);
      const MaterialRows<Kind, T> rows(effects, environment);
      for (int lane = 0; lane < block_lanes; ++lane) {
        const StencilPart<T> part{&plan, int(b), lane};
        if (plan.stencil_measure[part.stencil()] == T(0)) continue;
        T numbers[Kind::numbers];
        rows.read(plan.stencil_row[part.stencil()], dissipates<Kind> ? per_time : T(1), numbers);
        visit(rest_weight<Kind>(numbers), first + plan.stencil_order[part.stencil()]);
      }
    });
  }
}

// Lanes that a pack of one environment holds; a pack of several holds one stencil.
template <class Lanes>
constexpr int stencil_lanes = 1;
template <class T>
constexpr int stencil_lanes<Single<T>> = native_width<T>;

// visit(kind, part) for every pack of stencils of a patch.
template <class Lanes, class T, class Visit>
void each_stencil(const Plan<T>& plan, int patch, const Visit& visit) {
  for (int block = plan.patch_stencil[patch]; block < plan.patch_stencil[patch + 1]; ++block) {
    with_kind(plan.stencil_block[4 * block], [&](auto kind) {
      for (int lane = 0; lane < block_lanes; lane += stencil_lanes<Lanes>)
        visit(kind, StencilPart<T>{&plan, block, lane});
    });
  }
}

}  // namespace pd::inline PD_TARGET
