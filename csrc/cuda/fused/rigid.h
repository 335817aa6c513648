// Members of FusedRunner for the coarse correction, see cuda/rigid/rounds.h.
#pragma once
#include "cuda/fused/runner.h"
#include "cuda/rigid/rounds.h"

namespace pd::inline PD_TARGET {

// A correction, once contact forces have been kept.
template <class T, bool HasContacts, Blocks Kind>
class FusedRounds {
 public:
  const DevicePlan<T>& plan;
  Correction<T, HasContacts> of;
  Quad<T>*origin, *position;  // as in FusedRunner
  Piece* pieces;              // of this block
  double* part_sums;
  int index;  // patch
  TeamSums<Kind> sums;

  PD_DEVICE void run() {
    find_motions<HasContacts>(plan, *this);
    each_slot(
        [&](int s, int vertex, const Piece& piece) { return of.corrected(s, vertex, piece.body); });
    if (!has_choice(plan, of.from)) return;
    find<Round::rises>();
    each_slot([&](int s, int, const Piece& piece) { return of.chosen(s, piece.body, piece.rise); });
  }

  template <Round What>
  PD_DEVICE void find() {
    // all blocks have read the previous rows of parts
    if (Kind != Blocks::one && plan.sum_levels == 0) sums.sync();
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    const int end = plan.patch_part[index + 1];
    for (int n = plan.patch_part[index] + warp; n < end; n += warps) {
      const Part part(plan, n, false, -plan.patch_slot[index]);
      sum_part<What>(of, plan, part, pieces[part.piece(plan)],
                     part_sums + PartSums::count * plan.part_row[n]);
    }
    sums.sync();
    for (int level = 0; level < plan.sum_levels; ++level) {
      const int first = plan.level_sum[level] + index * warps + warp;
      for (int n = first; n < plan.level_sum[level + 1]; n += plan.patches * warps)
        sum_rows<What>(plan, n, part_sums);
      sums.sync();
    }
    for (int n = warp; n < plan.pieces; n += warps) sum_piece<What>(plan, n, part_sums, pieces[n]);
    __syncthreads();
    for (int n = threadIdx.x; n < plan.pieces; n += blockDim.x)
      move_piece<What>(plan, n, of.from, of.contacts.exist(), pieces[n]);
    __syncthreads();
  }

  // The same in every block of the team, since each block computes all motions.
  PD_DEVICE bool some_search() const {
    return some_of(plan.pieces, [&](int n) { return !pieces[n].body.is_done(); });
  }

 private:
  // Moves the vertices of pieces to next(slot, vertex, piece) in every patch that holds them, not only
  // in the patch of their part.
  template <class Next>
  PD_DEVICE void each_slot(const Next& next) const {
    const Patch<T> patch(plan, index);
    const int slots = Kind == Blocks::cluster ? patch.interior : patch.slots;
    for (int s = threadIdx.x; s < slots; s += blockDim.x) {
      const int number = plan.slot_piece[patch.first_slot + s];
      if (number < 0 || !(of.v.u[s].w > 0)) continue;  // of no free piece, or pinned
      const Vec3<T> u = next(s, patch.vertex(s), pieces[number]);
      of.v.set(s, u);
      if constexpr (Kind != Blocks::cluster) position[s] = quad(vec3(origin[s]) + u);
    }
    __syncthreads();
  }
};

// Out of line, for smaller stacks. Returns the team's state.
template <class T, bool HasContacts, Blocks Kind>
PD_DEVICE_COLD TeamSums<Kind> run_rounds(const FusedRounds<T, HasContacts, Kind>& of) {
  FusedRounds<T, HasContacts, Kind> rounds = of;
  rounds.run();
  return rounds.sums;
}

// All corrections, by a copy of the runner: registers live across its calls are spilled here and not
// in the iterations. Returns the state of the team's exchanges.
template <class Runner>
PD_DEVICE_COLD auto correct_out_of_line(const Runner& of, bool first) {
  Runner run = of;
  run.correct_pieces(first);
  return run.exchanges();
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::align_pieces() {
  const bool first = !started_;
  started_ = true;
  if (plan_.pieces == 0 || (first && set_.start() == StartKind::given)) return;
  forget();
  const FusedRunner copy = *this;  // its address may be taken; this runner stays in registers
  const Exchanges after = correct_out_of_line(copy, first);
  sums_ = after.sums;
  round_ = after.round;
  waited_ = after.waited;
  moved_ = true;
  // reloads the prefetched data: registers live across calls would be spilled in the iterations too
  if constexpr (Many) load_own();
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                           HasStencils>::correct_pieces(bool first) {
  const bool both = first && plan_.solid_pieces > 0;
  if (both) take_present_shape();
#pragma unroll 1
  for (int n = both ? 0 : 1; n < 2; ++n) {
    const Iterate from = iterate_of(n, first);
    // a kernel for contacts may serve a scene without
    if (first || contacts_.exist()) keep_forces(from);
    sums_ = run_rounds<T, HasContacts, Kind>({plan_, correction(from), origin_,
                                              Clustered ? nullptr : position_, &piece(0),
                                              part_sums(), index_, sums_});
    moved_ = true;
  }
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::take_present_shape() {
  const Correction<T, HasContacts> present = correction(Iterate::present);
  each_slot([&](int s) {
    if (plan_.slot_piece[patch_.first_slot + s] >= 0) move(s, present.present(s));
  });
  moved_ = true;
  __syncthreads();
}

// The owner of a vertex keeps its forces.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::keep_forces(
    Iterate from) {
  const Correction<T, HasContacts> keeper = correction(from);
  pass<false>(
      SolidGradient<false>{}, [] {}, false,
      [&](const WorkItem& at, const LoadedVertex&, const Vec3<T>& force) {
        if (at.owned() && plan_.slot_piece[patch_.first_slot + at.slot] >= 0)
          keeper.keep_forces(at.slot, patch_.vertex(at.slot), force);
      });
  __syncthreads();
}

}  // namespace pd::inline PD_TARGET
