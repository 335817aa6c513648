// Members of FusedRunner that move pieces as rigid bodies, see cuda/rigid.h.
#pragma once
#include "cuda/fused.h"
#include "cuda/rigid.h"

namespace pd::inline PD_TARGET {

// a warp for each
template <class T, bool Touching, Blocks Kind, bool Near>
template <class Visit>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::each_part(const Visit& visit) const {
  const int warps = blockDim.x / warp_size;
  for (int part = plan_.patch_part[index_] + int(threadIdx.x) / warp_size;
       part < plan_.patch_part[index_ + 1]; part += warps)
    visit(part, plan_.part_start[part], plan_.part_start[part + 1]);
}

template <class T, bool Touching, Blocks Kind, bool Near>
template <class Visit>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::each_piece(const Visit& visit) const {
  const int warps = blockDim.x / warp_size;
  for (int piece = int(threadIdx.x) / warp_size; piece < plan_.pieces; piece += warps) visit(piece);
}

template <class T, bool Touching, Blocks Kind, bool Near>
template <Rigid What>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::move_pieces() {
  if constexpr (Many) sums_.meet();  // everyone has read the sums of the last time
  each_part([&](int part, int begin, int end) {
    const auto index = [&](int at) { return plan_.part_slot[at] - patch_.first_slot; };
    const Piece<T>& piece = this->piece(plan_.slot_piece[plan_.part_slot[begin]]);
    double* sums = part_sums() + PartSums::count * part;
    sum_part<What>(v_, contacts_, plan_.pins > 0, begin, end, index, piece, sums);
  });
  sums_.meet();
  each_piece([&](int piece) {
    // past the first level of cache, which does not see what other blocks wrote
    const auto read = [&](int part, int n) {
      return __ldcg(part_sums() + PartSums::count * part + n);
    };
    move_piece<What>(plan_, piece, contacts_, read, this->piece(piece));
  });
  __syncthreads();
}

}  // namespace pd::inline PD_TARGET
