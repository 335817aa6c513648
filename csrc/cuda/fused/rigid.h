// Members of FusedRunner that move pieces as rigid bodies, see cuda/rigid/rounds.h.
#pragma once
#include "cuda/fused/runner.h"
#include "cuda/rigid/rounds.h"

namespace pd::inline PD_TARGET {

// Finds the motions, out of line: registers live across its calls are spilled here and not in the
// iterations.
template <class T, bool HasContacts, Blocks Kind>
struct MotionFinder {
  const DevicePlan<T>& plan;
  Vertices<T, HasContacts> v;
  Contacts<T> contacts;
  const Settings& settings;
  Piece<T>* pieces;  // of this block
  double* part_sums;
  int first_part, end_part, first_slot, slots;  // of its patch
  TeamSums<Kind> sums;

  template <Rigid What>
  PD_DEVICE void find(const Aligning& how) {
    if constexpr (Kind != Blocks::one) sums.sync();  // all blocks have read the previous sums
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    for (int n = first_part + warp; n < end_part; n += warps) {
      const Part part(plan, n, nullptr, -first_slot);
      sum_part<What>(v, contacts, settings, how, part, pieces[part.piece(plan)],
                     part_sums + PartSums::count * n);
    }
    sums.sync();
    for (int n = warp; n < plan.pieces; n += warps)
      move_piece<What>(plan, n, contacts, how, part_sums, pieces[n]);
    __syncthreads();
  }

  // Covers every patch that holds the vertices, not only the patch of their part.
  PD_DEVICE void begin_still() {
    for (int s = threadIdx.x; s < slots; s += blockDim.x) {
      const int number = plan.slot_piece[first_slot + s];
      if (number >= 0 && pieces[number].still) v.set(s, v.at(s).current_iterate(contacts));
    }
    __syncthreads();
  }

  // The same in every block of the team, since each block computes all motions.
  PD_DEVICE bool some_tip() const {
    return some_of(plan.pieces, [&](int n) { return pieces[n].tipping.goes_on(); });
  }
};

// Returns the team's state.
template <class T, bool HasContacts, Blocks Kind>
PD_DEVICE_COLD TeamSums<Kind> find_motions(MotionFinder<T, HasContacts, Kind> finder,
                                           Aligning how) {
  find_in_rounds<HasContacts>(finder, how, finder.contacts.has_multiple());
  return finder.sums;
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::align_pieces() {
  const bool first = !started_;
  started_ = true;
  if (plan_.pieces == 0 || (first && set_.start() == StartKind::given)) return;
  Aligning how(plan_, HasContacts, first);
  do {
    sums_ = find_motions<T, HasContacts, Kind>(
        {plan_, v_, contacts_, set_, &piece(0), part_sums(), plan_.patch_part[index_],
         plan_.patch_part[index_ + 1], patch_.first_slot, own_slots(), sums_},
        how);
    each_slot([&](int s) {
      const int number = plan_.slot_piece[patch_.first_slot + s];
      if (number < 0 || !(v_.u[s].w > 0)) return;  // of no free piece, or pinned
      const Vec3<T> u = v_.moved(s, piece(number).motion);
      move(s, u);
      if (first) v_.set_before(s, u);
    });
    moved_ = true;
    __syncthreads();
    how.go_on();
  } while (HasContacts && some_of(plan_.pieces, [&](int n) { return piece(n).leg == how.leg; }));
  // reloads the prefetched data: registers live across calls would be spilled in the iterations too
  if constexpr (Many) load_own();
}

}  // namespace pd::inline PD_TARGET
