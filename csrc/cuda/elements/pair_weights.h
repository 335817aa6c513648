// Weights of the pairs of a patch, computed from the material where a step or a field begins.
#pragma once
#include "cuda/elements/pairs_per_thread.h"

namespace pd::inline PD_TARGET {

// V 2 mu and V lambda of one tetrahedron of a pair; of a diagonal the weight twice, see PairPressure.
template <class Side, class T, class Numbers>
PD_DEVICE void compute_group_weights(const DevicePlan<T>& plan, const Numbers& numbers,
                                     PairPlace place, const Moduli<T>& moduli, WeightKind kind,
                                     T* weights) {
  const unsigned at = place.in(2) + Side::which * pair_lanes;
  const unsigned to = place.in(pair_weights) + Side::which * pair_lanes;
  const int tet = tet_of(plan, place, Side::which);
  const T volume = tet < 0 ? T(0) : numbers.template weight<Side>(T(1));
  const T bound = plan.pair_bound[at];
  Lame<T> lame = tet < 0 ? Lame<T>(T(0), T(0)) : moduli.lame(tet);
  if (bound < T(0) && kind != WeightKind::matrix) lame.lambda = T(0);
  const bool coupled = plan.members == 4 && Side::which == 0 &&
                       plan.pair_coupled[place.in(1)] != 0 && kind == WeightKind::force;
  const T weight = volume * lame.of(kind, absolute(bound));
  weights[to] = coupled ? -weight : weight;
  weights[to + 2 * pair_lanes] = kind == WeightKind::force ? volume * lame.lambda : weight;
}

// w V of both tetrahedra of a pair, times l_e for the majoriser.
template <class T, class Rest>
PD_DEVICE void compute_pair_weights(const DevicePlan<T>& plan, const Rest& rest, PairPlace place,
                                    const Moduli<T>& moduli, WeightKind kind, T* weights) {
  const T* stiffness = moduli.youngs;
  const bool bounded = kind == WeightKind::majoriser;
  const typename Rest::Numbers numbers =
      rest.read(place, load_pair<false, T>(plan, nullptr, place));
  if constexpr (has_poisson_ratio) {
    compute_group_weights<PairSide<T, 0>>(plan, numbers, place, moduli, kind, weights);
    compute_group_weights<PairSide<T, 1>>(plan, numbers, place, moduli, kind, weights);
    return;
  }
  const auto compute = [&](auto side) {
    using Side = decltype(side);
    const unsigned at = place.in(2) + Side::which * pair_lanes;
    const int tet = tet_of(plan, place, Side::which);
    const T bound = bounded ? plan.pair_bound[at] : T(1);
    weights[at] = tet < 0 ? T(0) : bound * numbers.template weight<Side>(stiffness[tet]);
  };
  compute(PairSide<T, 0>{});
  compute(PairSide<T, 1>{});
}

// The same for all pairs of a patch.
template <class T, class Rest>
PD_DEVICE void compute_patch_weights(const Patch<T>& patch, const Rest& rest,
                                     const Moduli<T>& moduli, WeightKind kind, T* weights) {
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x)
    compute_pair_weights(patch.plan, rest, place_of(patch, number), moduli, kind, weights);
}

// The common stiffness of a patch's tetrahedra, or -1 if they differ. All threads of the block must
// call it.
template <class T>
PD_DEVICE T one_stiffness(const Patch<T>& patch, const T* stiffness) {
  const T first = stiffness[tet_of(patch.plan, place_of(patch, 0), 0)];
  bool same = true;
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    for (int e = 0; e < 2; ++e) {
      const int tet = tet_of(patch.plan, place_of(patch, number), e);
      same = same && (tet < 0 || stiffness[tet] == first);
    }
  }
  return __syncthreads_and(same) ? first : T(-1);
}

}  // namespace pd::inline PD_TARGET
