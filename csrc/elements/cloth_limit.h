// Strain limit of a triangle: k / 2 dist^2(F, {stretches in [lo, hi]}), per area.
//
//   P = k R e(S),   S = R^T F = [p, q; q, r],   e(s) = s - clamp(s) of the stretches s = (p + r) / 2 +- m
//   e(S) = (e_1 + e_2) / 2 I + (e_1 - e_2) / 2m [(p - r) / 2, q; q, (r - p) / 2]
#pragma once
#include "elements/triangle.h"

namespace pd::inline PD_TARGET {

struct ClothLimit {
  static constexpr int corners = 3, dims = 2, constants = 0, rows = 3;
  static constexpr int numbers = 3;  // k V, lo, hi
  static constexpr bool large = true;

  template <class R>
  PD_HD static void parameters(const R (&row)[3], const R& measure, R (&p)[3]) {
    p[0] = measure * row[2];
    p[1] = row[0];
    p[2] = row[1];
  }

  // How far a stretch is above the limits, or below them: negative.
  template <class R>
  PD_HD static R excess(const R& s, const R (&p)[3]) {
    const R none(scalar_of<R>(0));
    return select(p[2] < s, s - p[2], select(s < p[1], s - p[1], none));
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[2], const R (&p)[3], const R (&)[1],
                           Vec3<R> (&stress)[2], R& energy) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), half(T(0.5));
    const NearestFrame<R> frame(f[0], f[1]);
    const R first = dot(frame.first, f[0]), last = dot(frame.second, f[1]);
    const R shear = half * (dot(frame.first, f[1]) + dot(frame.second, f[0]));
    const R mean = half * (first + last), apart = half * (first - last);
    const R m = square_root(multiply_add(apart, apart, shear * shear));
    const R larger = mean + m, smaller = mean - m;
    const R e1 = excess(larger, p), e2 = excess(smaller, p);
    // where both are outside on one side, e_1 - e_2 = 2 m
    const auto both = p[2] < smaller, neither = larger < p[1];
    const R known = select(none < m, m, one);
    const R ratio = select(both, one, select(neither, one, (half * (e1 - e2)) / known));
    if (Energy) energy = multiply_add(half * p[0], multiply_add(e1, e1, e2 * e2), energy);
    const R middle = half * (e1 + e2), turn = ratio * shear;
    const R one_one = multiply_add(ratio, apart, middle), two_two = middle - ratio * apart;
    stress[0] = p[0] * multiply_add(turn, frame.second, one_one * frame.first);
    stress[1] = p[0] * multiply_add(two_two, frame.second, turn * frame.first);
  }

  template <class R>
  PD_HD static R weight(const R (&p)[3], const R& l, const R&) {
    return p[0] * l;
  }
};

}  // namespace pd::inline PD_TARGET
