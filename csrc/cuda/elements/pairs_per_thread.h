// One patch of the mesh in a thread block: reads pairs of tetrahedra and computes one force per
// slot.
//
// A pair writes the force on each of its five corners to an entry of its own in shared memory.
// Every slot then sums its entries in a fixed order. There are no atomics, so every run gives the
// same bits.
#pragma once
#include "cuda/common/memory.h"
#include "cuda/elements/group_lanes.h"
#include "elements/solid.h"
#include "views/views.h"

#include <type_traits>

namespace pd::inline PD_TARGET {

constexpr int pair_lanes = 32;   // pairs per block of the plan
constexpr int no_entry = 65535;  // marks a corner that repeats another one and receives no force
constexpr int entry_stride = 8;  // consecutive entries of a slot are 8 apart

template <class T>
struct Patch {
  const DevicePlan<T>& plan;
  int index, first_block, pairs, outer, first_vertex, interior, first_slot, slots;

  PD_DEVICE Patch(const DevicePlan<T>& p, int number)
      : plan(p),
        index(number),
        first_block(p.patch_block[index]),
        pairs(p.patch_pairs[index]),
        outer(p.patch_outer[index]),
        first_vertex(p.patch_vertex[index]),
        interior(p.patch_vertex[index + 1] - first_vertex),
        first_slot(p.patch_slot[index]),
        slots(p.patch_slot[index + 1] - first_slot) {}

  PD_DEVICE int shared() const { return slots - interior; }
  PD_DEVICE int vertex(int slot) const {
    return slot < interior ? first_vertex + slot : plan.slot_vertex[first_slot + slot];
  }

  PD_DEVICE int row(int slot) const { return plan.slot_row[first_slot + slot]; }
  PD_DEVICE bool owns(int slot) const { return row(slot) >= 0; }
};

// Kernel stream: index of the force on a slot outside the interior. `end_vertex`: the end of the
// patch's interior vertices, which equals the number of interior slots up to and including this
// patch.
template <class T>
PD_DEVICE int place_of_force(const DevicePlan<T>& plan, int first_slot, int end_vertex, int slot) {
  return plan.shared_place[first_slot - end_vertex + slot];
}

// Two tetrahedra that share the face of corners 0, 1 and 2.
template <class T, int Fields>
struct Pair {
  Vec3<T> corner[Fields][5];
  Vec3<T> force[5];
};

// Selects one tetrahedron of a pair.
template <class T, int Which>
struct PairSide {
  using R = T;
  static constexpr int which = Which;

  PD_HD static Vec3<T> pick(const Vec3<T>& first, const Vec3<T>& second) {
    return Which ? second : first;
  }
  // the second tetrahedron adds to the forces of the first
  template <int Fields>
  PD_HD static void add(Pair<T, Fields>& pair, const Vec3<T> (&g)[4]) {
    for (int c = 0; c < 3; ++c) pair.force[c] = Which ? pair.force[c] + g[c] : g[c];
    pair.force[3 + Which] = g[3];
  }
};

// Index of a pair's data in the plan and in an environment's weights. 32 bits suffice, since a plan
// has at most most_blocks blocks.
struct PairPlace {
  unsigned pair;  // counted over all patches, with the last block of each patch padded

  PD_HD unsigned before() const {
    return pair & ~unsigned(pair_lanes - 1);
  }  // pairs in earlier blocks
  // Index of the pair's first number in an array with `width` numbers per pair; the others follow
  // at distance pair_lanes.
  PD_HD unsigned in(unsigned width) const { return pair + (width - 1) * before(); }
};

// The user's number of one tetrahedron of a pair, -1 if absent. Every patch that holds the
// tetrahedron returns it.
template <class T>
PD_DEVICE int tet_of(const DevicePlan<T>& plan, PairPlace place, int which) {
  const int tet = plan.pair_tet[place.in(2) + which * pair_lanes];
  return tet < -1 ? -2 - tet : tet;
}

template <class T>
PD_DEVICE PairPlace place_of(const Patch<T>& patch, int pair) {
  return {unsigned(patch.first_block) * pair_lanes + unsigned(pair)};
}

// V lambda of both tetrahedra; nothing without Poisson's ratio. A diagonal reads no V lambda: its weights repeat the
// weight there, with its sign.
template <class T, bool There = has_poisson_ratio>
struct PairPressure {};
template <class T>
struct PairPressure<T, true> {
  T pressure[2];
  bool coupled;
};

// Corners and weights of a pair; its rest shape is loaded separately.
template <class T>
struct PairInputs : PairPressure<T> {
  unsigned corner[5];
  T weight[2];

  // of tetrahedron e, for elements that read weights alone
  PD_HD const T& signed_weight(int e) const {
    if constexpr (has_poisson_ratio) return this->pressure[e];
    return weight[e];
  }

  PD_HD int slot(int c) const { return int(corner[c] & 0xffff) / 8; }
  PD_HD int entry(int c) const { return int(corner[c] >> 16); }
};

// Without `WithWeights`, the weights are not computed yet.
template <bool WithWeights = true, class T>
PD_DEVICE PairInputs<T> load_pair(const DevicePlan<T>& plan, const T* weights, PairPlace place) {
  PairInputs<T> numbers;
  const int32* const corner = plan.pair_corner + place.in(5);
  for (int c = 0; c < 5; ++c) numbers.corner[c] = unsigned(corner[c * pair_lanes]);
  for (int e = 0; e < 2; ++e) {
    numbers.weight[e] = T(0);
    if constexpr (WithWeights)
      numbers.weight[e] = (weights + place.in(pair_weights))[e * pair_lanes];
  }
  if constexpr (WithWeights && has_poisson_ratio) {
    numbers.coupled = has_sign(numbers.weight[0]);
    numbers.weight[0] = absolute(numbers.weight[0]);
    for (int e = 0; e < 2; ++e)
      numbers.pressure[e] = (weights + place.in(pair_weights))[(2 + e) * pair_lanes];
  }
  return numbers;
}

// Loads a corner's vector from an array in shared memory with one vector per slot; `corner` is
// encoded as in pair_corner.
template <class T>
PD_DEVICE Vec3<T> at_corner(const Quad<T>* vectors, unsigned corner) {
  const auto* bytes = reinterpret_cast<const std::byte*>(vectors);
  const unsigned slot_times_8 = in_register(corner & 0xffff);
  return vec3(*reinterpret_cast<const Quad<T>*>(bytes + slot_times_8 * (sizeof(Quad<T>) / 8)));
}

// Rest shapes stored in the plan, in the frame of the pair's face.
template <class T>
struct StoredRest {
  const T* rests;  // pair_rest

  struct Numbers {
    FaceRest<T, 2> face;
    T volume[2];

    // w V
    template <class Side>
    PD_HD T weight(T stiffness) const {
      return volume[Side::which] * stiffness;
    }
  };

  PD_DEVICE Numbers read(PairPlace place, const PairInputs<T>&) const { return read(place); }
  PD_DEVICE Numbers read(PairPlace place) const {
    const Quad<T>* const quad = quads(place);
    const Quad<T> face = quad[0], one = quad[pair_lanes], other = quad[2 * pair_lanes];
    return {{face.x, face.y, face.z, {vec3(one), vec3(other)}}, {one.w, other.w}};
  }
  // of one tetrahedron
  PD_DEVICE FaceRest<T, 1> read_one(PairPlace place, int which) const {
    const Quad<T>* const quad = quads(place);
    const Quad<T> face = quad[0], own = quad[(1 + which) * pair_lanes];
    return {face.x, face.y, face.z, {vec3(own)}};
  }

 private:
  // neighbouring lanes read neighbouring quads
  PD_DEVICE const Quad<T>* quads(PairPlace place) const {
    return reinterpret_cast<const Quad<T>*>(rests) + place.in(pair_rest_numbers / 4);
  }
};

// A rest position. In float32 it is an integer multiple of the patch's unit, so that differences
// are exact; in float64 it is in metres.
template <class T>
struct RestPoint;

template <>
struct alignas(16) RestPoint<float> {
  int32 x, y, z, none;

  PD_HD friend Vec3<float> operator-(const RestPoint& a, const RestPoint& b) {
    return {float(a.x - b.x), float(a.y - b.y), float(a.z - b.z)};
  }

  // the same bits, stored as floating-point numbers
  PD_DEVICE Vec3<float> bits() const {
    return {__int_as_float(x), __int_as_float(y), __int_as_float(z)};
  }
  PD_DEVICE static RestPoint of(const Vec3<float>& bits) {
    return {__float_as_int(bits.x), __float_as_int(bits.y), __float_as_int(bits.z), 0};
  }
};

template <>
struct alignas(16) RestPoint<double> {
  double x, y, z, none;

  PD_HD friend Vec3<double> operator-(const RestPoint& a, const RestPoint& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
  }

  PD_DEVICE Vec3<double> bits() const { return {x, y, z}; }
  PD_DEVICE static RestPoint of(const Vec3<double>& bits) { return {bits.x, bits.y, bits.z, 0}; }
};

// w V = w unit^2 / (6 |pair_factor|), split into a part per patch and a part per tetrahedron. All
// callers use these functions, so all get the same bits.
template <class T>
PD_HD T patch_weight(T unit, T stiffness) {
  return stiffness * (unit * unit / T(6));
}
template <class T>
PD_HD T tet_weight(T patch_weight, T factor) {
  return patch_weight * rough_reciprocal(absolute(factor));
}

// Rest shapes computed from rest positions and pair_factor, which take half the bytes of stored
// ones: for kernels bound by memory bandwidth.
template <class T>
struct ComputedRest {
  const RestPoint<T>* position;  // of every slot
  const T* factor;               // pair_factor
  T unit;                        // of positions [m]

  struct Numbers {
    FaceRest<T, 2> face;
    T factor[2], unit;

    template <class Side>
    PD_HD T weight(T stiffness) const {
      return tet_weight(patch_weight(unit, stiffness), factor[Side::which]);
    }
  };

  PD_DEVICE Numbers read(PairPlace place, const PairInputs<T>& pair) const {
    Numbers numbers;
    RestPoint<T> corner[5];
    for (int c = 0; c < 5; ++c) corner[c] = position[pair.slot(c)];
    for (int e = 0; e < 2; ++e) numbers.factor[e] = (factor + place.in(2))[e * pair_lanes];
    numbers.unit = unit;
    numbers.face = between(corner, T(1) / unit, numbers.factor);
    return numbers;
  }

  template <int Corners>
  PD_HD static auto between(const RestPoint<T> (&corner)[Corners], T per_unit,
                            const T (&factor)[Corners - 3]) {
    Vec3<T> edge[Corners - 1];
    for (int c = 1; c < Corners; ++c) edge[c - 1] = corner[c] - corner[0];
    return face_rest<T, Corners - 3>(edge, per_unit, factor);
  }
};

// Rest positions from a slot on, where the plan stores them.
template <class T>
PD_DEVICE const RestPoint<T>* rest_positions(const DevicePlan<T>& plan, int first_slot) {
  const void* positions = plan.slot_rest;
  if constexpr (sizeof(T) == 4) positions = plan.slot_fixed;
  return static_cast<const RestPoint<T>*>(positions) + first_slot;
}

// Rest shapes of a patch. `Computed`: the plan stores positions, which only kernel stream uses.
template <bool Computed, class T>
PD_DEVICE auto rest_of(const Patch<T>& patch) {
  if constexpr (!Computed) {
    return StoredRest<T>{patch.plan.pair_rest};
  } else {
    return ComputedRest<T>{rest_positions(patch.plan, patch.first_slot), patch.plan.pair_factor,
                           patch.plan.patch_unit[patch.index]};
  }
}

// Adapts one tetrahedron of a pair to the element interface of csrc/effects.
template <class T, int Fields, class Side>
struct PairElement {
  using R = typename Side::R;
  Pair<T, Fields>& pair;
  Mat3<R> inverse;
  R own_weight;
  R& energy;

  PD_HD void corners(int, int field, Vec3<R> (&x)[4]) const {
    for (int c = 0; c < 3; ++c) x[c] = Side::pick(pair.corner[field][c], pair.corner[field][c]);
    x[3] = Side::pick(pair.corner[field][3], pair.corner[field][4]);
  }
  PD_HD const Mat3<R>& rest(int) const { return inverse; }
  PD_HD const R& weight(int) const { return own_weight; }
  PD_HD R& sum(int) const { return energy; }
  PD_HD void add(int, const Vec3<R> (&g)[4]) const { Side::add(pair, g); }
};

// The same of a pair in a group, or of one of its tetrahedra that is a group of its own.
template <class T, int Fields, int Members, class Lanes>
struct PairGroup {
  static constexpr int members = Members;
  using R = T;
  Pair<T, Fields>& pair;
  const FaceRest<T, 2>& face;
  const PairInputs<T>& numbers;
  Lanes exchange;
  int first;  // tetrahedron of the pair
  T& energy;

  PD_HD void corners(int s, int field, Vec3<R> (&x)[4]) const {
    for (int c = 0; c < 3; ++c) x[c] = pair.corner[field][c];
    x[3] = pair.corner[field][3 + first + s];
  }
  PD_HD Mat3<R> rest(int s) const { return face.inverse(first + s); }
  PD_HD R weight(int s) const { return numbers.weight[first + s]; }
  PD_HD R pressure(int s) const { return numbers.pressure[first + s]; }
  PD_HD const Lanes& lanes() const { return exchange; }
  PD_HD R& sum(int) const { return energy; }
  PD_HD void add(int s, const Vec3<R> (&g)[4]) const {
    const bool second = first + s == 1;
    for (int c = 0; c < 3; ++c) pair.force[c] = second ? pair.force[c] + g[c] : g[c];
    pair.force[3 + first + s] = g[3];
  }
};

// An element functor of a pair with Poisson's ratio: visit(group) for the whole pair, or for each of its tetrahedra.
template <class T, int Fields, class Lanes, class Visit>
PD_DEVICE void each_group_of_pair(Pair<T, Fields>& pair, const FaceRest<T, 2>& face,
                                  const PairInputs<T>& numbers, int members, const Lanes& lanes,
                                  T& energy, const Visit& visit) {
  if (members == 1) {
    for (int e = 0; e < 2; ++e)
      visit(PairGroup<T, Fields, 1, WholeGroup>{pair, face, numbers, {}, e, energy});
  } else {
    visit(PairGroup<T, Fields, 2, Lanes>{pair, face, numbers, lanes, 0, energy});
  }
}

// Writes a force to its entry. The fourth component is never read, so it takes whatever the
// register holds.
template <class T>
PD_DEVICE void write_entry(const Vec3<T>& force, Quad<T>& entry) {
  entry = quad(force, undefined_number<T>());
}

// Applies an element functor to a pair, adds its energy and writes its forces. `read(corner,
// vectors)` loads the vectors of a corner's slot, encoded as in pair_corner.
template <int Fields, class T, class Read, class Shape, class Element>
PD_DEVICE void process_pair(const Read& read, const Shape& shape, const PairInputs<T>& numbers,
                            Quad<T>* entries, const Element& element, T& energy,
                            [[maybe_unused]] int members = 1,
                            [[maybe_unused]] bool neighbour = false) {
  using First = PairSide<T, 0>;
  using Second = PairSide<T, 1>;
  Pair<T, Fields> pair;
  for (int c = 0; c < 5; ++c) {
    Vec3<T> vectors[Fields];
    read(numbers.corner[c], vectors);
    for (int f = 0; f < Fields; ++f) pair.corner[f][c] = vectors[f];
  }
  if constexpr (has_poisson_ratio && !ReadsWeightsAlone<Element>) {
    const auto lanes = lanes_of_pair(members, numbers.coupled, neighbour);
    if constexpr (OnFaces<Element>) {
      element.run_group(pair.corner[0], shape.face, numbers.weight, numbers.pressure, members == 1,
                        lanes, pair.force, energy);
    } else {
      each_group_of_pair(pair, shape.face, numbers, members, lanes, energy, [&](const auto& group) {
        element.template run<std::remove_cvref_t<decltype(group)>::members>(group);
      });
    }
  } else if constexpr (OnFaces<Element>) {
    element.run_face(pair.corner[0], shape.face, numbers.weight, pair.force, energy);
  } else {
    element.template run<1>(PairElement<T, Fields, First>{pair, shape.face.inverse(0),
                                                          numbers.signed_weight(0), energy});
    element.template run<1>(PairElement<T, Fields, Second>{pair, shape.face.inverse(1),
                                                           numbers.signed_weight(1), energy});
  }
  for (int c = 0; c < 4; ++c) write_entry(pair.force[c], entries[numbers.entry(c)]);
  if (numbers.entry(4) != no_entry) write_entry(pair.force[4], entries[numbers.entry(4)]);
}

// Processes all pairs of a patch, one pair per thread; returns this thread's energy sum.
template <int Fields, class T, class Read, class Rest, class Element>
PD_DEVICE T each_pair(const Patch<T>& patch, const Read& read, const Rest& rest, const T* weights,
                      Quad<T>* entries, const Element& element) {
  T energy = T(0);
  weights = in_register(weights);
  const auto read_numbers = [&](int number) {
    return load_pair(patch.plan, weights, place_of(patch, min(number, patch.pairs - 1)));
  };
  PairInputs<T> now = read_numbers(threadIdx.x);
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    const typename Rest::Numbers shape = rest.read(place_of(patch, number), now);
    if constexpr (has_poisson_ratio) {
      process_pair<Fields>(read, shape, now, entries, element, energy, patch.plan.members,
                           (number ^ 1) < patch.pairs);
    } else {
      process_pair<Fields>(read, shape, now, entries, element, energy);
    }
    // loading here instead of at the top of the loop spills fewer registers
    now = read_numbers(number + int(blockDim.x));
  }
  return energy;
}

template <class T>
PD_DEVICE Vec3<T> sum_entries(const Quad<T>* entries, int row) {
  const Quad<T>* entry = entries + (unsigned(row) & 0xffff);
  const int count = row >> 16 & 0x7fff;
  Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 4
  for (int j = 0; j < count; ++j) sum = sum + vec3(entry[entry_stride * j]);
  return sum;
}

template <class T>
PD_DEVICE void clear_entries(Quad<T>* entries, int row) {
  Quad<T>* const entry = entries + (unsigned(row) & 0xffff);
  const int count = row >> 16 & 0x7fff;
  for (int j = 0; j < count; ++j) entry[entry_stride * j] = quad(Vec3<T>{T(0), T(0), T(0)});
}

// The same sum where latency matters: eight loads are in flight at once.
template <class T>
PD_DEVICE Vec3<T> sum_entries_by_8(const Quad<T>* entries, int row) {
  constexpr int in_flight = 8;
  const Quad<T>* entry = entries + (unsigned(row) & 0xffff);
  const int count = row >> 16 & 0x7fff;
  Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 1
  for (int j = 0; j < count; j += in_flight, entry += in_flight * entry_stride) {
    Vec3<T> force[in_flight];
#pragma unroll
    for (int i = 0; i < in_flight; ++i) {
      force[i] = {T(0), T(0), T(0)};
      if (j + i < count) force[i] = vec3(entry[entry_stride * i]);
    }
#pragma unroll
    for (int i = 0; i < in_flight; ++i) sum = sum + force[i];
  }
  return sum;
}

// The same sum in few instructions, for kernels bound by instruction issue. `Entries` acts like a
// pointer. `in_flight` loads are outstanding at once, each of which takes registers.
template <class T, int in_flight = 4, class Entries>
PD_DEVICE Vec3<T> sum_entries_compact(const Entries& entries, int row) {
  Entries entry = entries + (unsigned(row) & 0xffff);
  int left = row >> 16 & 0x7fff;
  Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 1
  for (; left >= in_flight; left -= in_flight, entry += in_flight * entry_stride) {
    Vec3<T> force[in_flight];
#pragma unroll
    for (int i = 0; i < in_flight; ++i) force[i] = vec3(entry[entry_stride * i]);
#pragma unroll
    for (int i = 0; i < in_flight; ++i) sum = sum + force[i];
  }
  Vec3<T> force[in_flight - 1];
#pragma unroll
  for (int i = 0; i < in_flight - 1; ++i)
    if (i < left) force[i] = vec3(entry[entry_stride * i]);
#pragma unroll
  for (int i = 0; i < in_flight - 1; ++i)
    if (i < left) sum = sum + force[i];
  return sum;
}

}  // namespace pd::inline PD_TARGET
