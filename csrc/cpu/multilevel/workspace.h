// Memory of the multilevel solver's iterations.
#pragma once
#include "cpu/multilevel/pieces_workspace.h"
#include "cpu/multilevel/v_cycle.h"
#include "math/mat.h"

namespace pd::inline PD_TARGET {

// Vectors of the multilevel iterations, beside those of a Workspace, whose u is the trial.
template <class Lanes>
struct MultilevelWork {
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;

  static constexpr int dots = 2 * history + 4;  // sums of one pass
  static constexpr int chunk = 256;             // vertices in one partial sum

  Cycle<Lanes> cycle;
  PiecesWork<Lanes> pieces;
  Value *iterate, *residual, *trial_residual,
      *direction;  // [vertices] iterate, residual there, residual at the trial, direction
  Value *s[history], *y[history];  // [vertices] L-BFGS pairs
  Mat3<Real>*free,
      *trial_free;  // [vertices] projectors on the free directions; null without contacts
  // [vertices] dE/du without the contacts' reaction, and friction; null without contacts
  Value *gradient, *trial_gradient, *friction, *trial_friction;
  Wide (*sums)[dots];                  // [chunks]
  RatioRange (*ranges)[ranges_count];  // [threads] ratios of the material to that of M
  int chunks;

  MultilevelWork(const StepCall<typename Lanes::Scalar>& call, bool has_contacts, int threads)
      : cycle(call.plan.levels),
        pieces(call.plan, call.settings.learns(), has_contacts,
               call.effects.poisson.data != nullptr, threads),
        chunks((call.plan.vertices + chunk - 1) / chunk) {
    const bool pairs = call.settings.learns();
    const std::int64_t n = call.plan.vertices, held = has_contacts ? n : 0;
    const std::int64_t vectors = 4 * n + 4 * held + (pairs ? 2 * history * n : 0);
    storage_ = allocate_zeroed(vectors * sizeof(Value) + 2 * held * sizeof(Mat3<Real>) +
                               chunks * sizeof(*sums) + threads * sizeof(*ranges) + 4 * alignment);
    std::byte* at = storage_.get();
    for (Value** field : {&iterate, &residual, &trial_residual, &direction})
      *field = place<Value>(at, n);
    for (int i = 0; i < history; ++i) {
      s[i] = place<Value>(at, pairs ? n : 0);
      y[i] = place<Value>(at, pairs ? n : 0);
    }
    for (Value** field : {&gradient, &trial_gradient, &friction, &trial_friction})
      *field = place<Value>(at, held);
    for (Mat3<Real>** field : {&free, &trial_free}) *field = place<Mat3<Real>>(at, held);
    sums = place<Wide[dots]>(at, chunks);
    ranges = place<RatioRange[ranges_count]>(at, threads);
  }

 private:
  static constexpr std::size_t alignment = 64;

  template <class Item>
  static Item* place(std::byte*& at, std::int64_t count) {
    const auto address = reinterpret_cast<std::uintptr_t>(at);
    Item* items =
        reinterpret_cast<Item*>((address + alignof(Item) - 1) / alignof(Item) * alignof(Item));
    at = reinterpret_cast<std::byte*>(items + count);
    return items;
  }

  Storage storage_;
};

}  // namespace pd::inline PD_TARGET
