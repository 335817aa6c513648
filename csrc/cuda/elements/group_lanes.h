// Groups of tetrahedra with Poisson's ratio on a GPU. A source that defines PD_POISSON, and a PD_TARGET of its own,
// compiles the kernels a second time for scenes that have it, or large kinds of stencils (elements/stencil.h).
//
// A group of two is a pair; one of four is two pairs in neighbouring lanes, 2k and 2k + 1. A group of three has a pair of
// which one tetrahedron is absent. Where a pair averages with its neighbour, the weight of its first tetrahedron is
// stored with a negative sign.
#pragma once
#include "cuda/common/memory.h"
#include "elements/corotated.h"
#include "elements/lame.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

#if defined(PD_POISSON)
constexpr bool has_poisson_ratio = true;
#else
constexpr bool has_poisson_ratio = false;
#endif

// Numbers of a pair in the weights: V 2 mu of both tetrahedra, then V lambda; w V alone without Poisson's ratio.
constexpr unsigned pair_weights = has_poisson_ratio ? 4 : 2;

// Elastic moduli of an environment; the second is null where Poisson's ratio is zero.
template <class T>
struct Moduli {
  const T *youngs, *poisson;

  PD_HD Moduli(const Values<T>& stiffness, const Values<T>& ratio, std::int64_t environment)
      : youngs(stiffness.of(environment)),
        poisson(has_poisson_ratio && ratio.data ? ratio.of(environment) : nullptr) {}

  PD_HD Lame<T> lame(std::int64_t tet) const {
    return {youngs[tet], poisson ? poisson[tet] : T(0)};
  }
};

// Whether environments have weights of their own.
template <class T>
PD_HD bool has_own_weights(const Values<T>& stiffness, const Values<T>& poisson) {
  return stiffness.stride != 0 || (has_poisson_ratio && poisson.stride != 0);
}

template <class T>
PD_DEVICE bool has_sign(T a) {
  return signbit(a);
}

// What the lanes of a warp have of a group. `Bits`: of the lane numbers of those who share it.
template <int Step>
struct LanesOfGroup {
  unsigned mask;   // of lanes that take part in an exchange with this one
  bool exchanges;  // false: this lane has all
  bool coupled;    // whether the number of another pair counts

  template <class R>
  PD_DEVICE R sum(const R& a) const {
    if (!exchanges) return a;
    const R other = __shfl_xor_sync(mask, a, Step);
    return coupled ? a + other : a;
  }
  template <class R>
  PD_DEVICE R least(const R& a) const {
    if (!exchanges) return a;
    const R other = __shfl_xor_sync(mask, a, Step);
    return coupled ? lesser(a, other) : a;
  }
  PD_DEVICE bool any(bool one) const { return exchanges ? __any_sync(mask, one) : one; }
};

// A pair in each lane: those of a couple are neighbours. `active`: whether the neighbour is.
PD_DEVICE LanesOfGroup<1> lanes_of_pair(int members, bool coupled, bool active) {
  const unsigned lane = threadIdx.x % 32u, both = 3u << (lane & ~1u), own = 1u << lane;
  return {active ? both : own, members == 4, coupled};
}

// A tetrahedron in each lane of a whole warp: first the other one of its pair, then those of the other pair.
struct LanesOfTets {
  bool exchanges;        // with the other tetrahedron of the pair
  LanesOfGroup<2> pair;  // with the other pair

  template <class R>
  PD_DEVICE R sum(const R& a) const {
    return exchanges ? pair.sum(a + __shfl_xor_sync(~0u, a, 1)) : a;
  }
  template <class R>
  PD_DEVICE R least(const R& a) const {
    return exchanges ? pair.least(lesser(a, __shfl_xor_sync(~0u, a, 1))) : a;
  }
  PD_DEVICE bool any(bool one) const { return exchanges ? __any_sync(~0u, one) : one; }
};
PD_DEVICE LanesOfTets lanes_of_tet(int members, bool coupled) {
  return {members > 1, {~0u, members == 4, coupled}};
}

}  // namespace pd::inline PD_TARGET
