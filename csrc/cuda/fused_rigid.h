// Members of FusedRunner that move pieces as rigid bodies, see cuda/rigid.h.
#pragma once
#include "cuda/fused.h"
#include "cuda/rigid.h"

namespace pd::inline PD_TARGET {

// What finds the motions: by itself, so that what lives across its calls is spilled here, and not in the iterations.
template <class T, bool Touching, Blocks Kind>
struct MotionFinder {
  const DevicePlan<T>& plan;
  Vertices<T, Touching> v;
  Contacts<T> contacts;
  const Settings& settings;
  Aligning how;
  Piece<T>* pieces;  // of this block
  double* part_sums;
  int first_part, end_part, first_slot, slots;  // of its patch
  TeamSums<Kind> sums;

  PD_DEVICE void run() {
    bool starts = false;
    if constexpr (Touching) {
      starts = how.first;
      if (starts) {
        find<Rigid::start>();
        begin_still();
      }
    }
    if (!starts && !how.at_once) find<Rigid::mean>();
    find<Rigid::free>();
    if constexpr (Touching) {
      find<Rigid::touching>();
      while (some_tip()) find<Rigid::tipping>();
      if (contacts.has_several()) find<Rigid::beside>();
    }
  }

 private:
  template <Rigid What>
  PD_DEVICE void find() {
    if constexpr (Kind != Blocks::one) sums.meet();  // everyone has read the sums of the last time
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    for (int n = first_part + warp; n < end_part; n += warps) {
      const Part part(plan, n, nullptr, -first_slot);
      sum_part<What>(v, contacts, settings, how, part, pieces[part.piece(plan)],
                     part_sums + PartSums::count * n);
    }
    sums.meet();
    for (int n = warp; n < plan.pieces; n += warps)
      move_piece<What>(plan, n, contacts, how, part_sums, pieces[n]);
    __syncthreads();
  }

  // In every patch that has the vertices, not only where their parts are.
  PD_DEVICE void begin_still() {
    for (int s = threadIdx.x; s < slots; s += blockDim.x) {
      const int number = plan.slot_piece[first_slot + s];
      if (number >= 0 && pieces[number].still) v.set(s, v.at(s).still(contacts));
    }
    __syncthreads();
  }

  // The same in every block of the team, since all of them work out all motions.
  PD_DEVICE bool some_tip() const {
    bool some = false;
    for (int n = threadIdx.x; n < plan.pieces; n += blockDim.x)
      some = some || pieces[n].tipping.goes_on();
    return __syncthreads_or(some);
  }
};

// Returns where the team stands.
template <class T, bool Touching, Blocks Kind>
PD_DEVICE_COLD TeamSums<Kind> find_motions(MotionFinder<T, Touching, Kind> finder) {
  finder.run();
  return finder.sums;
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::align_pieces() {
  const bool first = !started_;
  started_ = true;
  if (plan_.pieces == 0 || (first && set_.start == StartKind::given)) return;
  sums_ = find_motions<T, Touching, Kind>({plan_,
                                           v_,
                                           contacts_,
                                           set_,
                                           {plan_, Touching, first},
                                           &piece(0),
                                           part_sums(),
                                           plan_.patch_part[index_],
                                           plan_.patch_part[index_ + 1],
                                           patch_.first_slot,
                                           own_slots(),
                                           sums_});
  each_slot([&](int s) {
    const int number = plan_.slot_piece[patch_.first_slot + s];
    if (number < 0 || !(v_.u[s].w > 0)) return;  // of no piece, or pinned
    const Vec3<T> u = vec3(v_.u[s]) + piece(number).motion.of(vec3(v_.x[s]) + vec3(v_.u[s]));
    move(s, u);
    if (first) v_.set_before(s, u);
  });
  moved_ = true;
  __syncthreads();
  // again, since registers that live across calls would be spilled in the iterations too
  if constexpr (Many) read_own();
}

}  // namespace pd::inline PD_TARGET
