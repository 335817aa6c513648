// Energy of a length, d = 1:   psi = w / 2 (|F| - L)^2,   P = w (1 - L / |F|) F,   L >= 0.
//
// h = |F| and kappa' = -w L <= 0; F F^T has rank one, so the weight of the majoriser is w l_e, l_e = n corners. Where
// F = 0 every direction is nearest, and P = 0 is their mean. A slack length, shorter than L, may have no energy: the
// squared distance to a ball, with the same weight.
#pragma once
#include "elements/stencil.h"

namespace pd::inline PD_TARGET {

// a length on so many corners
template <int Corners>
struct Length {
  static constexpr int corners = Corners, dims = 1, constants = 0, numbers = 2;  // w V, L

  template <bool Energy, class R>
  PD_HD static void length_stress(const Vec3<R>& f, const R& w, const R& rest, bool goes_slack,
                                  const R& slack_share, Vec3<R>& p, R& energy) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), length = square_root(dot(f, f));
    const R strain = length - rest;
    // without a quotient where L = 0, so that a flat hinge is linear
    const R known = select(none < length, length, one);
    const R lag = select(none < length, select(none < rest, rest / known, none), one);
    R share = one;
    if (goes_slack) share = select(length < rest, slack_share, one);
    if (Energy) energy = multiply_add(R(T(0.5)) * (share * w), strain * strain, energy);
    p = ((share * w) * (one - lag)) * f;
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[1], const R (&p)[2], const R (&)[1],
                           Vec3<R> (&stress)[1], R& energy) {
    length_stress<Energy>(f[0], p[0], p[1], false, p[0], stress[0], energy);
  }

  template <class R>
  PD_HD static R weight(const R (&p)[2], const R& l, const R&) {
    return p[0] * l;
  }
};

}  // namespace pd::inline PD_TARGET
