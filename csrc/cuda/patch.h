// One patch of the mesh as a thread block works on it: pairs of tetrahedra in, one force for every slot out.
//
// A pair leaves the force on each of its five corners in an entry of its own in shared memory; then every slot adds up its
// entries, in their order. So nothing is added atomically, and the bits are the same in every run.
#pragma once
#include "cuda/memory.h"
#include "effects/solid.h"
#include "plan/views.h"

namespace pd::inline PD_TARGET {

constexpr int pair_lanes = 32;        // pairs of a block of the plan
constexpr unsigned no_entry = 65535;  // a corner that repeats another one leaves no force
constexpr int entry_stride = 8;       // entries of a slot lie 8 apart

template <class T>
struct Patch {
  const DevicePlan<T>& plan;
  int first_block, pairs, first_vertex, interior, first_slot, slots;

  __device__ Patch(const DevicePlan<T>& p, int index)
      : plan(p),
        first_block(p.patch_block[index]),
        pairs(p.patch_pairs[index]),
        first_vertex(p.patch_vertex[index]),
        interior(p.patch_vertex[index + 1] - first_vertex),
        first_slot(p.patch_slot[index]),
        slots(p.patch_slot[index + 1] - first_slot) {}

  __device__ int shared() const { return slots - interior; }
  __device__ int vertex(int slot) const { return plan.slot_vertex[first_slot + slot]; }

  // number of a slot's vertex among those that patches share
  __device__ int among_shared(int slot) const {
    return vertex(slot) - plan.patch_vertex[plan.patches];
  }

  __device__ bool owns(int slot) const {
    return slot < interior ||
           plan.shared_slot[plan.shared_start[among_shared(slot)]] == first_slot + slot;
  }
};

// Two tetrahedra that share the face of corners 0, 1 and 2.
template <class T, int Fields>
struct Pair {
  Vec3<T> corner[Fields][5];
  Vec3<T> force[5];
  Mat3<T> rest[2];
  T weight[2];
  T energy;
};

// One of the two, as effects see elements.
template <class T, int Fields, int Which>
struct PairElement {
  using R = T;
  Pair<T, Fields>& pair;

  PD_HD void corners(int, int field, Vec3<T> (&x)[4]) const {
    for (int c = 0; c < 3; ++c) x[c] = pair.corner[field][c];
    x[3] = pair.corner[field][3 + Which];
  }
  PD_HD const Mat3<T>& rest(int) const { return pair.rest[Which]; }
  PD_HD const T& weight(int) const { return pair.weight[Which]; }
  PD_HD T& sum(int) const { return pair.energy; }
  PD_HD void add(int, const Vec3<T> (&g)[4]) const {
    for (int c = 0; c < 3; ++c) pair.force[c] = Which ? pair.force[c] + g[c] : g[c];
    pair.force[3 + Which] = g[3];
  }
};

// Where a pair's numbers lie in the plan and in the weights of an environment.
struct PairPlace {
  std::int64_t block;
  int lane;

  PD_HD std::int64_t in(int width, int row) const {
    return (block * width + row) * pair_lanes + lane;
  }
};

template <class T>
__device__ PairPlace place_of(const Patch<T>& patch, int pair) {
  return {patch.first_block + pair / pair_lanes, pair % pair_lanes};
}

template <class T>
__device__ void load_rest(const DevicePlan<T>& plan, PairPlace place, Mat3<T> (&rest)[2],
                          T (&volume)[2]) {
  const Quad<T>* quads = reinterpret_cast<const Quad<T>*>(plan.pair_rest);
  const Quad<T> a = quads[place.in(5, 0)], b = quads[place.in(5, 1)], c = quads[place.in(5, 2)],
                d = quads[place.in(5, 3)], e = quads[place.in(5, 4)];
  rest[0] = {{{a.x, a.y, a.z}, {a.w, b.x, b.y}, {b.z, b.w, c.x}}};
  rest[1] = {{{c.y, c.z, c.w}, {d.x, d.y, d.z}, {d.w, e.x, e.y}}};
  volume[0] = e.z;
  volume[1] = e.w;
}

// Runs an effect on every pair of a patch; returns the sum of energies that this thread has met.
template <class T, int Fields, class Element>
__device__ T each_pair(const Patch<T>& patch, const Quad<T>* const (&field)[Fields],
                       const T* weights, Quad<T>* entries, const Element& element) {
  Pair<T, Fields> pair;
  pair.energy = T(0);
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    const PairPlace place = place_of(patch, number);
    unsigned corner[5];
    for (int c = 0; c < 5; ++c) corner[c] = unsigned(patch.plan.pair_corner[place.in(5, c)]);
    T volume[2];
    load_rest(patch.plan, place, pair.rest, volume);
    for (int e = 0; e < 2; ++e) pair.weight[e] = weights[place.in(2, e)];
    for (int f = 0; f < Fields; ++f) {
      for (int c = 0; c < 5; ++c) pair.corner[f][c] = vec3(field[f][corner[c] & 0xffff]);
    }
    element.template run<1>(PairElement<T, Fields, 0>{pair});
    element.template run<1>(PairElement<T, Fields, 1>{pair});
    for (int c = 0; c < 4; ++c) entries[corner[c] >> 16] = quad(pair.force[c]);
    if (corner[4] >> 16 != no_entry) entries[corner[4] >> 16] = quad(pair.force[4]);
  }
  return pair.energy;
}

// w V of every pair of a patch, times l_e when `bounded`.
template <class T>
__device__ void weigh_pairs(const Patch<T>& patch, const T* stiffness, bool bounded, T* weights) {
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    const PairPlace place = place_of(patch, number);
    Mat3<T> rest[2];
    T volume[2];
    load_rest(patch.plan, place, rest, volume);
    for (int e = 0; e < 2; ++e) {
      const int tet = patch.plan.pair_tet[place.in(2, e)];
      const T bound = bounded ? patch.plan.pair_bound[place.in(2, e)] : T(1);
      weights[place.in(2, e)] = tet < 0 ? T(0) : volume[e] * bound * stiffness[tet];
    }
  }
}

template <class T>
__device__ Vec3<T> sum_entries(const Quad<T>* entries, int row) {
  const Quad<T>* entry = entries + (unsigned(row) & 0xffff);
  const int count = int(unsigned(row) >> 16);
  Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 4
  for (int j = 0; j < count; ++j) sum = sum + vec3(entry[entry_stride * j]);
  return sum;
}

}  // namespace pd::inline PD_TARGET
