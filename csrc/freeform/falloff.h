// One perturbation R = a [Q]_+^3 with Q = 1 - |y|^2 and y = M (x - c): value, derivatives and
// adjoint side by side.
//
// R is the soft-object kernel of Wyvill et al. (1986) over an ellipsoid. It is a at the centre,
// 27/64 a at half the radius, and C2 across the boundary, where it ends. |dR/dr| is at most 96 /
// (25 sqrt 5) a over the radius.
//   grad R = -6 a q^2 M^T y,   Hess R w = M^T (24 a q (y.z) y - 6 a q^2 z),   z = M w,   q = [Q]_+
#pragma once
#include "freeform/simd4.h"

namespace pd::freeform::inline PD_TARGET {

// A lower triangular matrix.
template <class T>
struct Factor {
  T xx, yy, zz, yx, zx, zy;
};

template <class T>
PD_HD Factor<T> load_factor(const T* from, Index row) {
  const T* m = from + 6 * row;
  return {m[0], m[1], m[2], m[3], m[4], m[5]};
}

template <class T>
PD_HD Vec3<T> operator*(const Factor<T>& m, const Vec3<T>& a) {
  return {m.xx * a.x, multiply_add(m.yy, a.y, m.yx * a.x),
          multiply_add(m.zz, a.z, multiply_add(m.zy, a.y, m.zx * a.x))};
}

template <class T>
PD_HD Vec3<T> transposed_times(const Factor<T>& m, const Vec3<T>& a) {
  return {multiply_add(m.zx, a.z, multiply_add(m.yx, a.y, m.xx * a.x)),
          multiply_add(m.zy, a.z, m.yy * a.y), m.zz * a.z};
}

template <class T>
struct Bump {
  T a;
  Vec3<T> c;
  Factor<T> m;
};

template <class T>
PD_HD Bump<T> load_bump(const Ellipsoids<T>& of, Index quadric) {
  return {of.amplitudes[quadric], load3(of.centres, quadric), load_factor(of.factors, quadric)};
}

// Value and gradient of a sum of bumps.
template <class T>
struct Field {
  T value;
  Vec3<T> gradient;
};

// The sum over the quadrics of a patch. Quadrics that do not contain x are skipped instead of added
// as zeros.
template <class T>
PD_HD Field<T> bumps_at(const Ellipsoids<T>& of, const Lists& lists, Index patch,
                        const Vec3<T>& x) {
  Field<T> sum = {T(0), zero3<T>()};
  for (int32 e = lists.patch_start[patch]; e < lists.patch_start[patch + 1]; ++e) {
    const Bump<T> r = load_bump(of, lists.entry_quadric[e]);
    const Vec3<T> y = r.m * (x - r.c);
    const T q = T(1) - dot(y, y);
    if (!(q > T(0))) continue;
    sum.value = sum.value + r.a * (q * q * q);
    add(sum.gradient, T(-6) * r.a * (q * q), transposed_times(r.m, y));
  }
  return sum;
}

// The bumps of a patch.
template <class T>
struct PatchBumps {
  const Ellipsoids<T>& of;
  const Lists& lists;
  Index patch;
};

template <class T>
PD_HD Field<T> bumps_at(const PatchBumps<T>& b, const Vec3<T>& x) {
  return bumps_at(b.of, b.lists, b.patch, x);
}

template <class T>
PD_HD void bounds_of(const PatchBumps<T>& b, T& low, T& high) {
  for (int32 e = b.lists.patch_start[b.patch]; e < b.lists.patch_start[b.patch + 1]; ++e) {
    const T a = b.of.amplitudes[b.lists.entry_quadric[e]];
    (a > T(0) ? high : low) = (a > T(0) ? high : low) + a;
  }
}

// The same bumps in groups of four, component by component, for SIMD lanes. Missing bumps of the
// last group lie far away.
template <class T>
struct BumpSimd4 {
  const T* numbers;  // [count, 10, 4]
  int32 count;
};

constexpr int bump_simd4_size = 40;

// Index of a patch's first group. Every patch reserves room for its bumps plus at most one partial
// group.
PD_HD Index first_simd4(const Lists& lists, Index patch) {
  return lists.patch_start[patch] / 4 + patch;
}

PD_HD int32 simd4_count(const Lists& lists, Index patch) {
  return (lists.patch_start[patch + 1] - lists.patch_start[patch] + 3) / 4;
}

template <class T>
PD_HD void store_simd4(T* simd4, const Ellipsoids<T>& of, const Lists& lists, Index patch) {
  T* to = simd4 + bump_simd4_size * first_simd4(lists, patch);
  const int32 begin = lists.patch_start[patch], end = lists.patch_start[patch + 1];
  for (int32 n = 0; n < 4 * simd4_count(lists, patch); ++n) {
    Bump<T> r = {T(0), {T(1e15), T(0), T(0)}, {T(1), T(1), T(1), T(0), T(0), T(0)}};
    if (begin + n < end) r = load_bump(of, lists.entry_quadric[begin + n]);
    const T numbers[10] = {r.a,    r.c.x,  r.c.y,  r.c.z,  r.m.xx,
                           r.m.yy, r.m.zz, r.m.yx, r.m.zx, r.m.zy};
    for (int k = 0; k < 10; ++k) to[bump_simd4_size * (n / 4) + 4 * k + n % 4] = numbers[k];
  }
}

template <class T>
PD_HD Field<T> bumps_at(const BumpSimd4<T>& b, const Vec3<T>& x) {
  using L = Lanes<T>;
  using R = Number<T>;
  const Vec3<R> at = {R(x.x), R(x.y), R(x.z)};
  R value = R(T(0));
  Vec3<R> gradient = {R(T(0)), R(T(0)), R(T(0))};
  for (int32 n = 0; n < b.count; ++n) {
    for (int lane = 0; lane < 4; lane += L::width) {
      const T* m = b.numbers + bump_simd4_size * Index(n) + lane;
      const Vec3<R> c = {L::load(m + 4), L::load(m + 8), L::load(m + 12)};
      const Factor<R> factor = {L::load(m + 16), L::load(m + 20), L::load(m + 24),
                                L::load(m + 28), L::load(m + 32), L::load(m + 36)};
      const Vec3<R> y = factor * (at - c);
      const R none = R(T(0)), q = R(T(1)) - dot(y, y);
      const auto inside = q > none;
      if (bits_of(inside) == 0) continue;
      // infinite or NaN values count only inside the ellipsoid
      const R steep = L::load(m) * (q * q);
      const Vec3<R> slope = steep * transposed_times(factor, y);
      value = value + select(inside, steep * q, none);
      gradient = gradient + Vec3<R>{select(inside, slope.x, none), select(inside, slope.y, none),
                                    select(inside, slope.z, none)};
    }
  }
  return {L::sum(value),
          T(-6) * Vec3<T>{L::sum(gradient.x), L::sum(gradient.y), L::sum(gradient.z)}};
}

template <class T>
PD_HD void bounds_of(const BumpSimd4<T>& b, T& low, T& high) {
  for (int n = 0; n < 4 * b.count; ++n) {
    const T a = b.numbers[bump_simd4_size * (n / 4) + n % 4];
    (a > T(0) ? high : low) = (a > T(0) ? high : low) + a;
  }
}

// Hess R w, summed over the quadrics of a patch.
template <class T>
PD_HD Vec3<T> bumps_hessian_product(const Ellipsoids<T>& of, const Lists& lists, Index patch,
                                    const Vec3<T>& x, const Vec3<T>& w) {
  Vec3<T> sum = zero3<T>();
  for (int32 e = lists.patch_start[patch]; e < lists.patch_start[patch + 1]; ++e) {
    const Bump<T> r = load_bump(of, lists.entry_quadric[e]);
    const Vec3<T> y = r.m * (x - r.c);
    const T q = T(1) - dot(y, y);
    if (!(q > T(0))) continue;
    const Vec3<T> z = r.m * w;
    const Vec3<T> g = (T(24) * r.a * q * dot(y, z)) * y - (T(6) * r.a * (q * q)) * z;
    add(sum, transposed_times(r.m, g));
  }
  return sum;
}

// Gradient of mu R(x) + grad R(x) . w with respect to the ten numbers of a quadric.
template <class T>
struct BumpAdjoint {
  T a;
  Vec3<T> c;
  Factor<T> m;
};

template <class T>
PD_HD void bump_vjp(const Bump<T>& r, const Vec3<T>& x, const Vec3<T>& w, const T& mu,
                    BumpAdjoint<T>& g) {
  const Vec3<T> from = x - r.c, y = r.m * from;
  const T q = T(1) - dot(y, y);
  if (!(q > T(0))) return;
  const Vec3<T> z = r.m * w;
  const T along = dot(y, z), q2 = q * q;
  g.a = g.a + (mu * (q2 * q) - T(6) * q2 * along);
  const Vec3<T> gy = (r.a * (T(24) * q * along - T(6) * mu * q2)) * y - (T(6) * r.a * q2) * z;
  const Vec3<T> gz = (T(-6) * r.a * q2) * y;
  g.m.xx = g.m.xx + (gy.x * from.x + gz.x * w.x);
  g.m.yy = g.m.yy + (gy.y * from.y + gz.y * w.y);
  g.m.zz = g.m.zz + (gy.z * from.z + gz.z * w.z);
  g.m.yx = g.m.yx + (gy.y * from.x + gz.y * w.x);
  g.m.zx = g.m.zx + (gy.z * from.x + gz.z * w.x);
  g.m.zy = g.m.zy + (gy.z * from.y + gz.z * w.y);
  g.c = g.c - transposed_times(r.m, gy);
}

}  // namespace pd::freeform::inline PD_TARGET
