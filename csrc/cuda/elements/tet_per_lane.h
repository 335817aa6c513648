// Processes a patch like each_pair, with one lane per tetrahedron of a pair. The serial work
// halves, which helps patches small enough that latency dominates. Both lanes sum the forces on
// their shared corners, to the same bits.
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/common/slots.h"
#include "cuda/elements/pairs_per_thread.h"

namespace pd::inline PD_TARGET {

// Corners and weight of a lane's tetrahedron; even lanes hold the first tetrahedron of a pair.
template <class T, bool There = has_poisson_ratio>
struct TetPressure {};
template <class T>
struct TetPressure<T, true> {
  T pressure;    // V lambda; of a diagonal as in PairPressure
  bool coupled;  // whether its pair averages with a neighbour
};

template <class T>
struct TetInputs : TetPressure<T> {
  unsigned corner[4];  // 8 times the slot, plus 65536 times the entry
  T weight, factor;    // w V; pair_factor where rest shapes are computed

  // for elements that read weights alone
  PD_HD const T& signed_weight() const {
    if constexpr (has_poisson_ratio) return this->pressure;
    return weight;
  }

  PD_HD unsigned slot_times_8(int c) const { return corner[c] & 0xffff; }
};

// `number` counts tetrahedra; `Computed`: see rest_of. Without `WithWeights`, the weight is not
// computed yet.
template <bool Computed, bool WithWeights = true, class T>
PD_DEVICE TetInputs<T> load_tet(const Patch<T>& patch, const T* weights, int number) {
  TetInputs<T> numbers;
  // lanes past the end repeat the last pair
  const unsigned pair = unsigned(min(number / 2, patch.pairs - 1)), which = unsigned(number) & 1;
  // indices as in PairPlace, from the patch's block offsets
  const unsigned before = pair & ~unsigned(pair_lanes - 1);
  const unsigned of_five = unsigned(patch.first_block) * (5 * pair_lanes) + pair + 4 * before;
  const unsigned of_two = unsigned(patch.first_block) * (2 * pair_lanes) + pair + before;
  const auto corner = [&](unsigned c) {
    return unsigned(patch.plan.pair_corner[of_five + c * pair_lanes]);
  };
  for (unsigned c = 0; c < 3; ++c) numbers.corner[c] = corner(c);
  numbers.corner[3] = corner(3 + which);
  const unsigned own = of_two + which * pair_lanes;
  numbers.weight = T(0);
  if constexpr (WithWeights && has_poisson_ratio) {
    const unsigned first = place_of(patch, int(pair)).in(pair_weights);
    const T sign = weights[first];
    numbers.coupled = has_sign(sign);
    numbers.weight = absolute(weights[first + which * pair_lanes]);
    numbers.pressure = weights[first + (2 + which) * pair_lanes];
  } else if constexpr (WithWeights) {
    numbers.weight = weights[own];
  }
  numbers.factor = T(1);
  if constexpr (Computed) numbers.factor = patch.plan.pair_factor[own];
  return numbers;
}

// Stored rest shape of a lane's tetrahedron.
template <class T>
PD_DEVICE FaceRest<T, 1> tet_rest(const Patch<T>& patch, int number) {
  const PairPlace place = place_of(patch, min(number / 2, patch.pairs - 1));
  return rest_of<false>(patch).read_one(place, number % 2);
}

// Rest shape computed from the rest positions in the loaded slots.
template <class T>
PD_DEVICE FaceRest<T, 1> tet_rest(const TetInputs<T>& numbers, T per_unit, const Slots<T>& slots,
                                  const Quad<T> (&loaded)[4]) {
  RestPoint<T> point[4];
  for (int c = 0; c < 4; ++c)
    point[c] = RestPoint<T>::of(slots.second(numbers.slot_times_8(c), loaded[c]));
  return ComputedRest<T>::between(point, per_unit, {numbers.factor});
}

// Rest shape computed from the rest positions in global memory.
template <class T>
PD_DEVICE FaceRest<T, 1> tet_rest(const TetInputs<T>& numbers, T per_unit,
                                  const RestPoint<T>* rest) {
  RestPoint<T> point[4];
  for (int c = 0; c < 4; ++c) point[c] = rest[numbers.slot_times_8(c) / 8];
  return ComputedRest<T>::between(point, per_unit, {numbers.factor});
}

template <class T, class Slots>
PD_DEVICE void load_corners(const TetInputs<T>& numbers, const Slots& slots, Quad<T> (&loaded)[4]) {
  for (int c = 0; c < 4; ++c) loaded[c] = slots.load(numbers.slot_times_8(c));
}

// Adapts a tetrahedron to the element interface, for functors that read only rest shapes and
// weights.
template <class T>
struct TetElement {
  using R = T;
  Mat3<T> inverse;
  T own_weight;
  Vec3<T> (&force)[4];

  PD_HD const Mat3<T>& rest(int) const { return inverse; }
  PD_HD const T& weight(int) const { return own_weight; }
  PD_HD void add(int, const Vec3<T> (&g)[4]) const {
    for (int c = 0; c < 4; ++c) force[c] = g[c];
  }
};

template <class T>
PD_DEVICE Vec3<T> add_partner(const Vec3<T>& a) {
  return {a.x + __shfl_xor_sync(full_warp, a.x, 1), a.y + __shfl_xor_sync(full_warp, a.y, 1),
          a.z + __shfl_xor_sync(full_warp, a.z, 1)};
}

// Applies an element functor to the tetrahedra of all pairs; returns this thread's energy sum.
// `slots` holds positions. `now` is this thread's first tetrahedron, from load_tet.
// `shape_of(number, inputs, loaded)` returns a rest shape, given the loaded slots. `counts(number,
// energy)` decides whether an energy counts. `OnePerThread`: no thread has a second tetrahedron.
template <bool OnePerThread, bool Computed, class T, class Slots, class Element, class ShapeOf,
          class Counts>
PD_DEVICE T each_tet(const Patch<T>& patch, const Slots& slots, const ShapeOf& shape_of,
                     const Counts& counts, const T* weights, Quad<T>* entries,
                     const Element& element, TetInputs<T> now) {
  T energy = T(0);
  const int lane = int(threadIdx.x) % warp_size, all = 2 * patch.pairs;
  for (int first = int(threadIdx.x) - lane; first < all; first += blockDim.x) {
    TetInputs<T> next = now;
    if (!OnePerThread && first + int(blockDim.x) < all)
      next = load_tet<Computed>(patch, weights, first + int(blockDim.x) + lane);
    Vec3<T> x[4], force[4];
    Quad<T> loaded[4];
    load_corners(now, slots, loaded);
    for (int c = 0; c < 4; ++c) x[c] = vec3(loaded[c]);
    T tet_energy = T(0);
    const FaceRest<T, 1> rest = shape_of(first + lane, now, loaded);
    if constexpr (OnFaces<Element> && has_poisson_ratio) {
      const int members = patch.plan.members;
      element.run_group(x, rest, {now.weight}, {now.pressure}, members == 1,
                        lanes_of_tet(members, now.coupled), force, tet_energy);
    } else if constexpr (OnFaces<Element>) {
      element.run_face(x, rest, {now.weight}, force, tet_energy);
    } else {
      element.template run<1>(TetElement<T>{rest.inverse(0), now.signed_weight(), force});
    }
    for (int c = 0; c < 3; ++c) force[c] = add_partner(force[c]);
    const bool here = first + lane < all, second = lane & 1;
    // the first lane writes corners 0 and 1, the second corner 2, each its own apex
    const Vec3<T> own = {select(second, force[2].x, force[0].x),
                         select(second, force[2].y, force[0].y),
                         select(second, force[2].z, force[0].z)};
    const int entry = int((second ? now.corner[2] : now.corner[0]) >> 16);
    const int apex = int(now.corner[3] >> 16);
    if (here) {
      if (counts(first + lane, tet_energy)) energy += tet_energy;
      entries[entry] = quad(own);
      if (!second) entries[now.corner[1] >> 16] = quad(force[1]);
      if (apex != no_entry) entries[apex] = quad(force[3]);
    }
    if (OnePerThread) break;
    now = next;
  }
  return energy;
}

}  // namespace pd::inline PD_TARGET
