// Members of FusedRunner that move pieces as rigid bodies, see cuda/rigid.h.
#pragma once
#include "cuda/fused.h"
#include "cuda/rigid.h"

namespace pd::inline PD_TARGET {

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
template <Rigid What>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::find_motions() {
  if constexpr (Many) sums_.meet();  // everyone has read the sums of the last time
  const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
  double* sums = part_sums();
  const int end = plan_.patch_part[index_ + 1];
  for (int n = plan_.patch_part[index_] + warp; n < end; n += warps) {
    const Part part(plan_, n, nullptr, -patch_.first_slot);
    const Piece<T>& piece = this->piece(part.piece(plan_));
    sum_part<What>(v_, contacts_, plan_.pins > 0, parts_are_pieces(plan_), part, piece,
                   sums + PartSums::count * n);
  }
  sums_.meet();
  for (int n = warp; n < plan_.pieces; n += warps)
    move_piece<What>(plan_, n, contacts_, sums, this->piece(n));
  __syncthreads();
}

// The same in every block of the team, since all of them work out all motions.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE bool FusedRunner<T, Touching, Loose, Kind, Near>::some_tip() {
  bool some = false;
  for (int n = threadIdx.x; n < plan_.pieces; n += blockDim.x)
    some = some || piece(n).tipping.goes_on();
  return __syncthreads_or(some);
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::align_pieces() {
  const bool first = !started_;
  started_ = true;
  if (plan_.pieces == 0 || (first && set_.start == StartKind::given)) return;
  if (!parts_are_pieces(plan_)) find_motions<Rigid::mean>();
  find_motions<Rigid::free>();
  if constexpr (Touching) {
    find_motions<Rigid::touching>();
    while (some_tip()) find_motions<Rigid::tipping>();
    if (contacts_.has_several()) find_motions<Rigid::beside>();
  }
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
