// Volume of a tetrahedron: 3 lambda / 2 dist^2(F, {det F = 1})                       (Bouaziz et al. 2014)
//
// Beside mu |F - R|^2 it has the linear elasticity of Lame's constants at rest. Its nearest point has
//
//   z_i - s_i + m / z_i = 0,   z_1 z_2 z_3 = 1
//
// with the larger root of each equation, save perhaps for the smallest stretch s_3. So the point is a function of
// z_3 = t alone, m = t (s_3 - t), and one root of p(t) = z_1 z_2 t = 1. For t >= s_3 / 2, where s_3 has its larger
// root, p is convex and rises: Newton's method descends on it from t = 1, where p >= 1. Below it may have another root
// that is nearer.
#pragma once
#include "elements/stretch_law.h"

namespace pd::inline PD_TARGET {

// p(t) of the larger stretches a and b, and of c = s_3
template <class R>
struct VolumeCurve {
  R a, b, c, a2, b2;  // a2 = a^2 - c^2

  struct Point {
    R za, zb, product, slope;
  };

  PD_HD VolumeCurve(const R& first, const R& second, const R& least)
      : a(first), b(second), c(least), a2(gap(first)), b2(gap(second)) {}

  PD_HD Point at(const R& t) const {
    using T = scalar_of<R>;
    const R half(T(0.5)), u = t - (c - t);  // 2 t - c
    const R wa = square_root(multiply_add(u, u, a2)), wb = square_root(multiply_add(u, u, b2));
    const R za = half * (a + wa), zb = half * (b + wb), area = za * zb;
    const R da = u / above_zero(wa), db = u / above_zero(wb);
    return {za, zb, t * area, multiply_add(t, multiply_add(da, zb, za * db), area)};
  }

  // The root at t >= c / 2, or p > 1 at t where there is none.
  PD_HD R upper_root(R& product) const {
    using T = scalar_of<R>;
    const R one(T(1)), lowest = greater(R(T(0.5)) * c, R(T(0)));
    product = at(lowest).product;
    R t = greater(one, lowest);
    auto goes = product <= one;
    for (int step = 0; step < 64 && any(goes); ++step) {
      const Point p = at(t);
      const R next = greater(t - (p.product - one) / above_zero(p.slope), lowest);
      const R change = t - next;
      t = select(goes, next, t);
      goes = goes && R(T(2) * epsilon<T>()) * t < change;
    }
    return t;
  }

  // The least root in (1 / (a b), c / 2), or p < 1 at t where there is none: Newton's method within a bracket. p rises,
  // then falls.
  PD_HD R lower_root(R& product) const {
    using T = scalar_of<R>;
    const R one(T(1)), half(T(0.5)), tiny(T(2) * epsilon<T>());
    R low = one / above_zero(a * b), high = half * c, t = low;
    auto goes = low < high;
    product = R(T(0));
    for (int step = 0; step < 96 && any(goes); ++step) {
      const Point p = at(t);
      product = select(goes, p.product, product);
      const auto short_of = p.product < one && R(T(0)) < p.slope;
      low = select(goes, select(short_of, t, low), low);
      high = select(goes, select(short_of, high, t), high);
      const R step_to = t - (p.product - one) / off_zero(p.slope);
      const R next = select(low < step_to && step_to < high, step_to, half * (low + high));
      const R change = size_of(next - t);
      goes = goes && tiny * t < change && tiny < size_of(p.product - one);
      t = select(goes, next, t);
    }
    return t;
  }

 private:
  PD_HD R gap(const R& s) const { return greater((s - c) * (s + c), R(scalar_of<R>(0))); }
};

// The nearest z, and m
template <class R>
struct UnitVolume {
  R z[3], pull;
};

template <class R>
PD_CALLED void find_unit_volume(const R (&s)[3], UnitVolume<R>& found) {
  using T = scalar_of<R>;
  const R one(T(1));
  const auto first = s[0] <= s[1] && s[0] <= s[2];
  const auto second = !first && s[1] <= s[2];
  const R a = select(first, s[1], s[0]), b = select(first, s[2], select(second, s[2], s[1]));
  const R c = select(first, s[0], select(second, s[1], s[2]));
  const VolumeCurve<R> curve(a, b, c);
  const auto squared_distance = [&](const R& t) {
    const auto p = curve.at(t);
    const R x = a - p.za, y = b - p.zb, z = c - t;
    return multiply_add(x, x, multiply_add(y, y, z * z));
  };
  R start, reached;
  R t = curve.upper_root(start);
  // p(t) <= a b t
  if (any(R(T(2)) < (a * b) * c)) [[unlikely]] {
    const R other = curve.lower_root(reached);
    const auto is_there = R(T(1) - T(64) * epsilon<T>()) < reached && R(T(2)) < (a * b) * c;
    const auto nearer = !(start <= one && squared_distance(t) <= squared_distance(other));
    t = select(is_there && nearer, other, t);
  }
  const auto point = curve.at(t);
  found.z[0] = select(first, t, point.za);
  found.z[1] = select(first, point.za, select(second, t, point.zb));
  found.z[2] = select(first, point.zb, select(second, point.zb, t));
  found.pull = t * (c - t);
}

struct Volume : StretchLaw<Volume, 1> {  // 3 lambda V
  static constexpr int rows = 2;

  template <class R>
  PD_HD static void parameters(const R (&row)[2], const R& measure, R (&p)[1]) {
    using T = scalar_of<R>;
    const R one(T(1)), two(T(2)), three(T(3));
    const R &youngs = row[0], &poisson = row[1];
    p[0] = measure * (three * youngs * poisson / ((one + poisson) * (one - two * poisson)));
  }

  // Tetrahedra have lambda in the matrix of preconditioners, also where this kind has their volume energy.
  template <class R>
  PD_HD static R rest_weight(const R (&)[1]) {
    return R(scalar_of<R>(0));
  }

  // s - z = m / z
  template <class V, class R>
  PD_HD static void excess(const V (&s)[3], const R (&)[1], R (&excess)[3]) {
    UnitVolume<V> nearest;
    find_unit_volume(s, nearest);
    for (int i = 0; i < 3; ++i)
      excess[i] = Still<R>::number(nearest.pull / above_zero(nearest.z[i]));
  }

  template <class R>
  struct Nearest : UnitVolume<R> {
    using UnitVolume<R>::z;
    using UnitVolume<R>::pull;

    PD_HD Nearest(const R (&s)[3], const R (&)[1]) { find_unit_volume(s, *this); }

    // (z_i - z_j) (1 - m / z_i z_j) = s_i - s_j, and the same with plus signs
    PD_HD R share(int i, int j) const { return pull / above_zero(z[i] * z[j]); }
    PD_HD R along(int i, int j) const {
      const R one(scalar_of<R>(1));
      return one / off_zero(one - share(i, j));
    }
    PD_HD R across(int i, int j) const {
      const R one(scalar_of<R>(1));
      return one / off_zero(one + share(i, j));
    }
    // (1 - m / z_i^2) dz_i + dm / z_i = ds_i,   sum dz_i / z_i = 0
    PD_HD void change(const R (&ds)[3], R (&dz)[3]) const {
      const R one(scalar_of<R>(1));
      R per[3], stiff[3], moved(scalar_of<R>(0)), total = moved;
      for (int i = 0; i < 3; ++i) {
        per[i] = one / above_zero(z[i]);
        stiff[i] = off_zero(one - pull * (per[i] * per[i]));
      }
      for (int i = 0; i < 3; ++i) {
        const R others = (stiff[(i + 1) % 3] * stiff[(i + 2) % 3]) * per[i];
        moved = multiply_add(others, ds[i], moved);
        total = multiply_add(others, per[i], total);
      }
      const R pulled = moved / off_zero(total);
      for (int i = 0; i < 3; ++i) dz[i] = (ds[i] - pulled * per[i]) / stiff[i];
    }
  };
};

}  // namespace pd::inline PD_TARGET
