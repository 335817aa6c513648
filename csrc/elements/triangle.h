// Membrane of a triangle in plane stress, d = 2: corotated, with a capped tension.
//
//   psi = mu |F - R|^2 + (lambda t^2 / 2 if lambda t <= 2 mu, else 2 mu t - 2 mu^2 / lambda),   t = R : (F - R)
//   P = (2 mu - p) (F - R) + p F,   p = min(lambda t, 2 mu)
//   R = [a + b x n, b - a x n] / h,   h = sqrt(|a|^2 + |b|^2 + 2 |a x b|),   n = a x b / |a x b|,   F = [a, b]
//   2 mu = Y / (1 + nu),   lambda = Y nu / (1 - nu^2),   Y = E thickness       per area
//
// R is the nearest frame of two orthonormal columns. Where a x b = 0 any n normal to the longer column serves. The cap
// keeps kappa' = p - 2 mu <= 0, which the majoriser needs; it is reached where the area has grown by (1 - nu) / nu.
#pragma once
#include "elements/stencil.h"

namespace pd::inline PD_TARGET {

// a unit vector normal to a, or any if a = 0
template <class R>
PD_HD Vec3<R> some_normal(const Vec3<R>& a) {
  using T = scalar_of<R>;
  const R none(T(0)), one(T(1));
  const R x2 = a.x * a.x, y2 = a.y * a.y, z2 = a.z * a.z;
  // across the axis of the smallest component
  const auto by_x = x2 <= y2 && x2 <= z2, by_y = y2 <= z2;
  const Vec3<R> axis = {select(by_x, one, none), select(by_x, none, select(by_y, one, none)),
                        select(by_x, none, select(by_y, none, one))};
  const Vec3<R> n = cross(a, axis);
  const R square = dot(n, n);
  const R scale = one / square_root(select(none < square, square, one));
  return {select(none < square, scale * n.x, one), select(none < square, scale * n.y, none),
          select(none < square, scale * n.z, none)};
}

// The two orthonormal columns nearest to a and b.
template <class R>
struct NearestFrame {
  Vec3<R> first, second;

  PD_HD NearestFrame(const Vec3<R>& a, const Vec3<R>& b) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1));
    const Vec3<R> c = cross(a, b);
    const R a2 = dot(a, a), b2 = dot(b, b), area2 = dot(c, c), area = square_root(area2);
    const auto good = (a2 + b2) * R(epsilon<T>()) < area;
    const R per_area = one / select(good, area, one);
    const auto longer = b2 <= a2;
    const Vec3<R> instead = some_normal(
        Vec3<R>{select(longer, a.x, b.x), select(longer, a.y, b.y), select(longer, a.z, b.z)});
    const Vec3<R> n = {select(good, per_area * c.x, instead.x),
                       select(good, per_area * c.y, instead.y),
                       select(good, per_area * c.z, instead.z)};
    const Vec3<R> r0 = a + cross(b, n), r1 = b - cross(a, n);
    const R h2 = dot(r0, r0);  // |r0| = |r1| = h
    const R per_h = one / square_root(select(none < h2, h2, one));
    first = per_h * r0;
    second = per_h * r1;
  }
};

struct Triangle {
  static constexpr int corners = 3, dims = 2, constants = 0, rows = 3;
  static constexpr int numbers = 2;  // 2 mu V, lambda V

  template <class R>
  PD_HD static void parameters(const R (&row)[3], const R& measure, R (&p)[2]) {
    const R one(scalar_of<R>(1));
    const R &youngs = row[0], &poisson = row[1], &thickness = row[2];
    p[0] = measure * (youngs * thickness) / (one + poisson);
    p[1] = p[0] * poisson / (one - poisson);
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[2], const R (&p)[2], const R (&)[1],
                           Vec3<R> (&stress)[2], R& energy) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), half(T(0.5));
    const Vec3<R>&a = f[0], &b = f[1];
    const NearestFrame<R> frame(a, b);
    const Vec3<R> d0 = a - frame.first, d1 = b - frame.second;
    const R trace = dot(frame.first, d0) + dot(frame.second, d1);
    const R most = p[0], linear = p[1] * trace;
    const auto capped = most < linear;
    const R tension = select(capped, most, linear);
    if (Energy) {
      const R shape = half * p[0] * (dot(d0, d0) + dot(d1, d1));
      const R known = select(none < p[1], p[1], one);
      const R volume = select(capped, most * (trace - half * most / known), half * linear * trace);
      energy = energy + shape + volume;
    }
    stress[0] = multiply_add(most - tension, d0, tension * a);
    stress[1] = multiply_add(most - tension, d1, tension * b);
  }

  // The positive part of the second derivative, number 3 j + a: component a of column j of F. With V P = 2 mu F - k R
  // and the stretches s_i it is 2 mu, and lambda on the trace, less as much of these as leaves no negative eigenvalue:
  // 2 k / (s_1 + s_2) on the turn in the plane, and k / s_i on the turns out of it.
  template <class R>
  PD_HD static void positive_hessian(const Vec3<R> (&f)[2], const R (&p)[2], R (&second)[6][6]) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), half(T(0.5));
    const NearestFrame<R> frame(f[0], f[1]);
    const Vec3<R> axes[2] = {frame.first, frame.second}, normal = cross(frame.first, frame.second);
    const R s00 = dot(axes[0], f[0]), s01 = dot(axes[0], f[1]), s11 = dot(axes[1], f[1]);
    const R both = s00 + s11,
            linear = p[1] * (dot(axes[0], f[0] - axes[0]) + dot(axes[1], f[1] - axes[1]));
    const auto capped = p[0] < linear;
    const R bulk = select(capped, none, p[1]), k = select(capped, none, p[0] - linear);
    const auto softened = [&](const R& stretch) {
      const auto all = p[0] * stretch <= k;
      return select(all, p[0], k / select(all, one, stretch));
    };
    const R turn = softened(half * both);
    const R apart = half * (s00 - s11), spread = square_root(multiply_add(s01, s01, apart * apart));
    const R larger = softened(half * both + spread), smaller = softened(half * both - spread);
    const R mean = half * (larger + smaller);
    const R slope = half * (larger - smaller) / select(none < spread, spread, one);
    const R bend[2][2] = {{multiply_add(slope, apart, mean), slope * s01},
                          {slope * s01, subtract_product(mean, slope, apart)}};
    const auto number = [](const Vec3<R>& v, int a) { return a == 0 ? v.x : a == 1 ? v.y : v.z; };
    const Vec3<R> turned[2] = {axes[1], -axes[0]};
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c < 6; ++c) {
        const int j = r / 3, l = c / 3, a = r % 3, b = c % 3;
        R sum = r == c ? p[0] : none;
        sum = multiply_add(bulk, number(axes[j], a) * number(axes[l], b), sum);
        sum = subtract_product(sum, half * turn, number(turned[j], a) * number(turned[l], b));
        second[r][c] = subtract_product(sum, bend[j][l], number(normal, a) * number(normal, b));
      }
    }
  }

  template <class R>
  PD_HD static R weight(const R (&p)[2], const R& l, const R& n) {
    const R none(scalar_of<R>(0));
    return multiply_add(n, select(p[1] < none, none, p[1]), p[0] * l);
  }
};

}  // namespace pd::inline PD_TARGET
