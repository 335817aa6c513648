// Pairs of a patch whose numbers lie far away, in memory that answers late: each thread asks for its next pair while it works on
// one, in a pass's last round for the first of the next pass.
#pragma once
#include "cuda/patch.h"

namespace pd::inline PD_TARGET {

// All that the plan and an environment say of a pair.
template <class T>
struct PrefetchedPair {
  PairInputs<T> numbers;
  typename StoredRest<T>::Numbers rest;
};

// `number`: of the pair; past the end the last one, which nobody works on.
template <class T>
PD_DEVICE PrefetchedPair<T> prefetch_pair(const Patch<T>& patch, const T* weights, int number) {
  const PairPlace place = place_of(patch, min(number, patch.pairs - 1));
  return {load_pair(patch.plan, weights, place), rest_of<false>(patch).read(place)};
}

// Runs an effect on the pairs [begin, end); returns the sum of energies that this thread has met. `begin` and an `end` before the
// last are multiples of the threads. `now`: this thread's first pair from `begin` on; after it that from `end` on, or its first of
// all where there is none.
template <class T, class Element>
PD_DEVICE T each_prefetched_pair(const Patch<T>& patch, const Quad<T>* position, const T* weights,
                                 Quad<T>* entries, const Element& element, PrefetchedPair<T>& now,
                                 int begin, int end) {
  T energy = T(0);
#pragma unroll 1
  for (int number = begin + int(threadIdx.x); number < end; number += blockDim.x) {
    const PrefetchedPair<T> pair = now;
    const auto read = [&](unsigned corner, Vec3<T>(&x)[1]) { x[0] = at_corner(position, corner); };
    const int next = number + int(blockDim.x);
    now = prefetch_pair(patch, weights, next < patch.pairs ? next : int(threadIdx.x));
    process_pair<1>(read, pair.rest, pair.numbers, entries, element, energy);
  }
  __syncwarp();
  return energy;
}

}  // namespace pd::inline PD_TARGET
