// Prefetched pairs for patches whose data is in global memory. Each thread loads its next pair
// while it processes one. The last round of a pass prefetches the first pair of the next pass.
#pragma once
#include "cuda/elements/pairs_per_thread.h"

namespace pd::inline PD_TARGET {

// All data of a pair: corners, weights and rest shape.
template <class T>
struct PrefetchedPair {
  PairInputs<T> numbers;
  typename StoredRest<T>::Numbers rest;
};

// `number` counts pairs; past the end it repeats the last pair, whose result is unused.
template <class T>
PD_DEVICE PrefetchedPair<T> prefetch_pair(const Patch<T>& patch, const T* weights, int number) {
  const PairPlace place = place_of(patch, min(number, patch.pairs - 1));
  return {load_pair(patch.plan, weights, place), rest_of<false>(patch).read(place)};
}

// Applies an element functor to the pairs [begin, end); returns this thread's energy sum. `begin`
// is a multiple of the number of threads, as is `end` unless it is the last. `now` is this thread's
// first pair from `begin` on. On return it is the first pair from `end` on, or the thread's very
// first pair if none is left.
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
    if constexpr (has_poisson_ratio) {
      process_pair<1>(read, pair.rest, pair.numbers, entries, element, energy, patch.plan.members,
                      (number ^ 1) < end);
    } else {
      process_pair<1>(read, pair.rest, pair.numbers, entries, element, energy);
    }
  }
  __syncwarp();
  return energy;
}

}  // namespace pd::inline PD_TARGET
