// Members of FusedRunner that prepare an environment: its state in the memory of the block, its weights.
#pragma once
#include "cuda/fused.h"

namespace pd::inline PD_TARGET {

template <class T, bool Touching, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::load() {
  if (threadIdx.x == 0) in_.read_contacts(planes_, balls_);
  contacts_ = {planes_, balls_, call_.material.planes_count, call_.material.spheres_count};
  each_slot([&](int s) {
    v_.load(s, in_, patch_.vertex(s), h_);
    const Vec3<T> none = {T(0), T(0), T(0)};
    if constexpr (Many) {
      slots_.set(s, none, rest_of<true>(patch_).position[s].bits());
    } else {
      position_[s] = quad(none);
    }
  });
  __syncthreads();
}

template <class T, bool Touching, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::move_balls() {
  if constexpr (!Touching) return;
  __syncthreads();
  for (int b = threadIdx.x; b < contacts_.ball_count; b += blockDim.x)
    balls_[b].center = balls_[b].center + balls_[b].motion;
  __syncthreads();
}

// a and 1 / D of every vertex, w V of every element, and the smallest a / D
template <class T, bool Touching, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::weigh() {
  const T* stiffness = call_.material.stiffness.of(in_.environment);
  weigh_with(stiffness, set_.weighted);
  if (threadIdx.x == 0) control_.progress.done = false;
  pending_ = false;
  __syncthreads();
  double least = HUGE_VAL;
  pass<false>(
      SolidDiagonal{}, [] {}, false,
      [&](const Seat& at, const Seen&, const Vec3<T>& elastic) {
        least = Least{}(least, v_.weigh(at.slot, elastic.x));
      });
  sums_.all_reduce({least, 0, 0}, 1, Least{});
  if (threadIdx.x == 0) control_.progress.least = sums_.total(0);
  if (set_.weighted) weigh_with(stiffness, false);
  __syncthreads();
}

template <class T, bool Touching, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Kind, Near>::weigh_with(const T* stiffness, bool bounded) {
  weigh_pairs(patch_, rest_of<Many>(patch_), stiffness, bounded, weights());
  __syncthreads();  // one lane has left the weights of two
  if constexpr (Many) half_ = read_half(patch_, weights(), threadIdx.x);
  if constexpr (Many && Near) {
    Quad<T> seen[4];
    look(half_, slots_, seen);
    inverse_ = half_inverse(half_, slots_, seen);
  }
}

}  // namespace pd::inline PD_TARGET
