// Groups of four values, stored component by component. A CPU processes as many at once as a SIMD
// register of 16 bytes holds. A GPU, whose threads are its lanes, processes them one after another.
//   for (int lane = 0; lane < 4; lane += Lanes<T>::width) { Number<T> a = Lanes<T>::load(from + lane); ... }
#pragma once
#include "freeform/views.h"

#if !defined(__CUDACC__)
#include "math/pack.h"

namespace pd::inline PD_TARGET {

template <class T, int W>
PD_HD Pack<T, W> greater(const Pack<T, W>& a, const Pack<T, W>& b) {
  return b.v > a.v ? b.v : a.v;
}

template <class T, int W>
PD_HD Pack<T, W> absolute(const Pack<T, W>& a) {
  return greater(a, -a);
}

template <class T, int W>
PD_HD Mask<T, W> operator<=(const Pack<T, W>& a, const Pack<T, W>& b) {
  return {a.v <= b.v};
}

}  // namespace pd::inline PD_TARGET
#endif

namespace pd::freeform::inline PD_TARGET {

PD_HD unsigned bits_of(bool a) { return a; }

#if defined(__CUDACC__)
template <class T>
struct Lanes {
  using Number = T;
  static constexpr int width = 1;

  PD_HD static T load(const T* from) { return *from; }
  PD_HD static void store(T* to, const T& a) { *to = a; }
  PD_HD static T sum(const T& a) { return a; }
};

#else
template <class T>
struct Lanes {
  static constexpr int width = 16 / sizeof(T);
  using Number = Pack<T, width>;

  PD_HD static Number load(const T* from) { return Number::load(from); }
  PD_HD static void store(T* to, const Number& a) { std::memcpy(to, &a.v, sizeof(a.v)); }
  PD_HD static T sum(const Number& a) {
    if constexpr (width == 4) return (a.v[0] + a.v[1]) + (a.v[2] + a.v[3]);
    return a.v[0] + a.v[1];
  }
};

// Bit k is set if the mask holds in lane k.
template <class T, int W>
PD_HD unsigned bits_of(const Mask<T, W>& mask) {
#if defined(__SSE2__)
  if constexpr (sizeof(mask.m) == 16 && sizeof(T) == 4) return _mm_movemask_ps((__m128)mask.m);
  if constexpr (sizeof(mask.m) == 16 && sizeof(T) == 8) return _mm_movemask_pd((__m128d)mask.m);
#endif
  unsigned bits = 0;
  for (int lane = 0; lane < W; ++lane) bits |= unsigned(mask.m[lane] != 0) << lane;
  return bits;
}
#endif

template <class T>
using Number = typename Lanes<T>::Number;

}  // namespace pd::freeform::inline PD_TARGET
