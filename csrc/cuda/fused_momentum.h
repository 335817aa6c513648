// Members of FusedRunner that shift free pieces, see cuda/momentum.h.
#pragma once
#include "cuda/fused.h"
#include "cuda/momentum.h"

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
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::find_shifts() {
  if constexpr (Many) sums_.meet();  // everyone has read the sums of the last time
  each_part([&](int part, int begin, int end) {
    double sum[4];
    sum_part(v_, begin, end, [&](int at) { return local(at); }, sum);
    if (lane() == 0) {
      for (int c = 0; c < 4; ++c) part_sums()[4 * part + c] = sum[c];
    }
  });
  sums_.meet();
  each_piece([&](int piece) {
    double sum[4];
    over_parts(plan_, piece, Add{}, [&](int part, int c) { return part_sum(4 * part + c); }, sum);
    if (lane() == 0) shift(piece) = shift_of<T>(sum);
  });
  __syncthreads();
}

// a piece that the shift would leave touching a contact gets none
template <class T, bool Touching, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::drop_touching_shifts() {
  sums_.meet();  // everyone has read the sums
  each_part([&](int part, int begin, int end) {
    const Vec3<T> moved = vec3(shift(plan_.slot_piece[plan_.part_slot[begin]]));
    const auto index = [&](int at) { return local(at); };
    const double least = least_gap(v_, contacts_, begin, end, index, moved);
    if (lane() == 0) part_sums()[4 * part] = least;
  });
  sums_.meet();
  each_piece([&](int piece) {
    double least[1];
    over_parts(plan_, piece, Least{}, [&](int part, int) { return part_sum(4 * part); }, least);
    if (lane() == 0 && !(least[0] > 0)) shift(piece) = {};
  });
  __syncthreads();
}

}  // namespace pd::inline PD_TARGET
