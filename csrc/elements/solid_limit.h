// Strain limit of a tetrahedron: k / 2 dist^2(F, {stretches in [lo, hi], det F > 0}). Clamping the signed stretches keeps
// their order, so it gives the nearest point.
#pragma once
#include "elements/stretch_law.h"

namespace pd::inline PD_TARGET {

struct SolidLimit : StretchLaw<SolidLimit, 3> {  // k V, lo, hi
  static constexpr int rows = 3;

  template <class R>
  PD_HD static void parameters(const R (&row)[3], const R& measure, R (&p)[3]) {
    p[0] = measure * row[2];
    p[1] = row[0];
    p[2] = row[1];
  }

  // |F - R| bounds how far any stretch is from one. Less than the whole way to a limit, so that rounding does not matter.
  template <class V, class R>
  PD_HD static auto rests(const Mat3<V>& f, const Mat3<V>& rotation, const R (&p)[3]) {
    const V one(scalar_of<V>(1)), share(scalar_of<V>(0.99));
    const V least = lesser(one - Still<R>::value(p[1]), Still<R>::value(p[2]) - one);
    const V reach = share * greater(least, V(scalar_of<V>(0)));
    const Mat3<V> apart = f - rotation;
    return frobenius(apart, apart) <= reach * reach;
  }

  template <class V, class R>
  PD_HD static void excess(const V (&s)[3], const R (&p)[3], R (&excess)[3]) {
    for (int i = 0; i < 3; ++i) {
      const R stretch = Still<R>::number(s[i]);
      excess[i] = stretch - lesser(greater(stretch, p[1]), p[2]);
    }
  }

  template <class R>
  struct Nearest {
    R s[3], z[3], inside[3];  // inside: 1 or 0

    PD_HD Nearest(const R (&stretch)[3], const R (&p)[3]) {
      const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
      for (int i = 0; i < 3; ++i) {
        s[i] = stretch[i];
        z[i] = lesser(greater(s[i], p[1]), p[2]);
        inside[i] = select(s[i] < p[1], none, select(p[2] < s[i], none, one));
      }
    }
    PD_HD R along(int i, int j) const {
      const R none(scalar_of<R>(0)), apart = s[i] - s[j];
      return select(none < size_of(apart), (z[i] - z[j]) / off_zero(apart), inside[i]);
    }
    PD_HD R across(int i, int j) const { return (z[i] + z[j]) / above_zero(s[i] + s[j]); }
    PD_HD void change(const R (&ds)[3], R (&dz)[3]) const {
      for (int i = 0; i < 3; ++i) dz[i] = inside[i] * ds[i];
    }
  };
};

}  // namespace pd::inline PD_TARGET
