// W numbers that one instruction handles: a number type for the physics headers.
//
// Built on the vector extension of GCC and Clang, so the same source serves AVX-512, AVX2, SSE2 and NEON. Intrinsics
// serve where the compiler has no operator: square root, reciprocal, gather, "any lane".
#pragma once
#include "math/mat.h"
#include "math/scalar.h"
#include "math/svd.h"

#include <cstdint>
#include <cstring>
#include <type_traits>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace pd::inline PD_TARGET {

// GCC needs the attribute on a member type, not on a dependent typedef.
template <class T, int W>
struct VectorOf {
  using type [[gnu::vector_size(sizeof(T) * W)]] = T;
};

// The lanes in which a comparison holds.
template <class T, int W>
struct Mask {
  using Vector = decltype(typename VectorOf<T, W>::type{} > typename VectorOf<T, W>::type{});
  Vector m;

  PD_HD friend Mask operator&&(Mask a, Mask b) { return {a.m & b.m}; }
  PD_HD friend Mask operator!(Mask a) { return {~a.m}; }
};

template <class T, int W>
struct Pack {
  using scalar = T;
  using Vector = typename VectorOf<T, W>::type;
  static constexpr int width = W;

  Vector v;

  Pack() = default;
  PD_HD Pack(Vector a) : v(a) {}
  PD_HD Pack(T a) : v(a - Vector{}) {}
  PD_HD explicit Pack(int a) : Pack(T(a)) {}
  PD_HD explicit Pack(double a)
    requires(!std::is_same_v<T, double>)
      : Pack(T(a)) {}

  // Loads from any address: an unaligned load of aligned data costs the same.
  PD_HD static Pack load(const T* from) {
    Pack r;
    std::memcpy(&r.v, from, sizeof(Vector));
    return r;
  }

  PD_HD void store(T* to) const { std::memcpy(to, &v, sizeof(Vector)); }

  PD_HD friend Pack operator+(Pack a, Pack b) { return a.v + b.v; }
  PD_HD friend Pack operator-(Pack a, Pack b) { return a.v - b.v; }
  PD_HD friend Pack operator*(Pack a, Pack b) { return a.v * b.v; }
  PD_HD friend Pack operator/(Pack a, Pack b) { return a.v / b.v; }
  PD_HD friend Pack operator-(Pack a) { return -a.v; }
  PD_HD friend Mask<T, W> operator>(Pack a, Pack b) { return {a.v > b.v}; }
  PD_HD friend Mask<T, W> operator<=(Pack a, Pack b) { return {a.v <= b.v}; }
  PD_HD friend Mask<T, W> operator<(Pack a, Pack b) { return {a.v < b.v}; }
};

template <class T, int W>
PD_HD Pack<T, W> select(Mask<T, W> take, Pack<T, W> a, Pack<T, W> b) {
  return take.m ? a.v : b.v;
}

template <class T, int W>
PD_HD Pack<T, W> lesser(Pack<T, W> a, Pack<T, W> b) {
  return b.v < a.v ? b.v : a.v;
}

template <class T, int W>
PD_HD bool any(Mask<T, W> mask) {
  using V = typename Mask<T, W>::Vector;
#if PD_VECTOR_BYTES == 64
  if constexpr (sizeof(V) == 64)
    return _mm512_test_epi32_mask((__m512i)mask.m, (__m512i)mask.m) != 0;
#endif
#if PD_VECTOR_BYTES >= 32
  if constexpr (sizeof(V) == 32) return !_mm256_testz_si256((__m256i)mask.m, (__m256i)mask.m);
#endif
  std::int64_t words[sizeof(V) / 8], all = 0;
  std::memcpy(words, &mask.m, sizeof(V));
  for (std::int64_t word : words) all |= word;
  return all != 0;
}

// The same lanes in another precision.
template <class To, class T, int W>
PD_HD Pack<To, W> convert(Pack<T, W> a) {
  return __builtin_convertvector(a.v, typename Pack<To, W>::Vector);
}

template <class T, int W>
PD_HD Pack<T, W> square_root(Pack<T, W> a) {
  using V [[maybe_unused]] = typename Pack<T, W>::Vector;
#if PD_VECTOR_BYTES == 64
  if constexpr (sizeof(V) == 64 && sizeof(T) == 4) return V(_mm512_sqrt_ps((__m512)a.v));
  if constexpr (sizeof(V) == 64 && sizeof(T) == 8) return V(_mm512_sqrt_pd((__m512d)a.v));
#endif
#if PD_VECTOR_BYTES >= 32
  if constexpr (sizeof(V) == 32 && sizeof(T) == 4) return V(_mm256_sqrt_ps((__m256)a.v));
  if constexpr (sizeof(V) == 32 && sizeof(T) == 8) return V(_mm256_sqrt_pd((__m256d)a.v));
#endif
  Pack<T, W> r;
  for (int lane = 0; lane < W; ++lane) r.v[lane] = square_root(T(a.v[lane]));
  return r;
}

template <class T, int W>
PD_HD Pack<T, W> multiply_add(Pack<T, W> a, Pack<T, W> b, Pack<T, W> c) {
  using V [[maybe_unused]] = typename Pack<T, W>::Vector;
#if PD_VECTOR_BYTES == 64
  if constexpr (sizeof(V) == 64 && sizeof(T) == 4)
    return V(_mm512_fmadd_ps((__m512)a.v, (__m512)b.v, (__m512)c.v));
  if constexpr (sizeof(V) == 64 && sizeof(T) == 8)
    return V(_mm512_fmadd_pd((__m512d)a.v, (__m512d)b.v, (__m512d)c.v));
#endif
#if PD_VECTOR_BYTES >= 32
  if constexpr (sizeof(V) == 32 && sizeof(T) == 4)
    return V(_mm256_fmadd_ps((__m256)a.v, (__m256)b.v, (__m256)c.v));
  if constexpr (sizeof(V) == 32 && sizeof(T) == 8)
    return V(_mm256_fmadd_pd((__m256d)a.v, (__m256d)b.v, (__m256d)c.v));
  if constexpr (sizeof(V) == 16 && sizeof(T) == 4)
    return V(_mm_fmadd_ps((__m128)a.v, (__m128)b.v, (__m128)c.v));
  if constexpr (sizeof(V) > PD_VECTOR_BYTES) {  // by halves, which fuse as a scalar does
    Pack<T, W / 2> x[2], y[2], z[2];
    Pack<T, W> r;
    std::memcpy(x, &a.v, sizeof(V));
    std::memcpy(y, &b.v, sizeof(V));
    std::memcpy(z, &c.v, sizeof(V));
    for (int half = 0; half < 2; ++half) x[half] = multiply_add(x[half], y[half], z[half]);
    std::memcpy(&r.v, x, sizeof(V));
    return r;
  }
#endif
  return a * b + c;
}

template <class T, int W>
PD_HD Pack<T, W> subtract_product(Pack<T, W> c, Pack<T, W> a, Pack<T, W> b) {
  return multiply_add(-a, b, c);
}

template <class T, int W>
PD_HD Pack<T, W> multiply_subtract(Pack<T, W> a, Pack<T, W> b, Pack<T, W> c) {
  return multiply_add(a, b, -c);
}

template <class T, int W>
PD_HD Pack<T, W> rough_square_root(Pack<T, W> a) {
  return square_root(a);
}

// About 14 bits on AVX-512, which suffices for a Newton step: it corrects itself.
template <class T, int W>
PD_HD Pack<T, W> rough_reciprocal(Pack<T, W> a) {
  using V [[maybe_unused]] = typename Pack<T, W>::Vector;
#if PD_VECTOR_BYTES == 64
  if constexpr (sizeof(V) == 64 && sizeof(T) == 4) return V(_mm512_rcp14_ps((__m512)a.v));
  if constexpr (sizeof(V) == 32 && sizeof(T) == 4) return V(_mm256_rcp14_ps((__m256)a.v));
  if constexpr (sizeof(V) == 64 && sizeof(T) == 8) return V(_mm512_rcp14_pd((__m512d)a.v));
  if constexpr (sizeof(V) == 32 && sizeof(T) == 8) return V(_mm256_rcp14_pd((__m256d)a.v));
#endif
  return Pack<T, W>(T(1)) / a;
}

// To the last bit or two in float: one Newton step on the hardware's estimate.
template <class T, int W>
PD_HD Pack<T, W> reciprocal(Pack<T, W> a) {
  if constexpr (sizeof(T) == 4) {
    const Pack<T, W> r = rough_reciprocal(a);
    return multiply_add(r, subtract_product(Pack<T, W>(T(1)), a, r), r);
  }
  return Pack<T, W>(T(1)) / a;
}

// Recomputes, one by one, the lanes in which the fast rotation is inaccurate.
template <class T, int W>
PD_COLD void repair_lanes(const Mat3<Pack<T, W>>& f, Mask<T, W> good, Mat3<Pack<T, W>>& r) {
  for (int lane = 0; lane < W; ++lane) {
    if (good.m[lane]) continue;
    Mat3<T> one;
    for (int a = 0; a < 3; ++a)
      one.row[a] = {f.row[a].x.v[lane], f.row[a].y.v[lane], f.row[a].z.v[lane]};
    one = rotation_by_svd(one);
    for (int a = 0; a < 3; ++a) {
      r.row[a].x.v[lane] = one.row[a].x;
      r.row[a].y.v[lane] = one.row[a].y;
      r.row[a].z.v[lane] = one.row[a].z;
    }
  }
}

// Copies, so that the hot path may keep F and R in registers.
template <class T, int W>
PD_HD void repair_rotation(const Mat3<Pack<T, W>>& f, Mask<T, W> good, Mat3<Pack<T, W>>& r) {
  const Mat3<Pack<T, W>> copy = f;
  Mat3<Pack<T, W>> repaired = r;
  repair_lanes<T, W>(copy, good, repaired);
  r = repaired;
}

}  // namespace pd::inline PD_TARGET
