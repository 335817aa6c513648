// Laws of the distance to a set of stretches, d = 3:   psi = w / 2 |F - Z|^2,   Z = U diag(z(s)) V^T
//
// z is the nearest point of the set to the signed stretches s of F = U diag(s) V^T, so Z is the nearest matrix whose
// stretches lie in it. Z is constant in the gradient: P = w (F - Z). For every other F' psi <= w / 2 |F' - Z|^2, hence
// the weight w l_e of the majoriser, whether the set is convex or not.
//
//   dZ = U M' V^T,   M = U^T dF V,   M'_ii = sum_j dz_i/ds_j M_jj
//   pairs: the symmetric part of M times (z_i - z_j) / (s_i - s_j), the other times (z_i + z_j) / (s_i + s_j)
//
// A law may tell by rests(F, R, p) where it has neither energy nor stress: no stretches are computed if all lanes rest.
// A law's Nearest<R>(s, p) has z, and from it `along` and `across`, the two factors of a pair, and `change`, dz along ds.
#pragma once
#include "elements/stencil.h"
#include "math/stretch.h"

namespace pd::inline PD_TARGET {

// a, but at least the smallest number that has an inverse
template <class R>
PD_HD R above_zero(const R& a) {
  return greater(a, R(smallest<scalar_of<R>>() * scalar_of<R>(4)));
}
// the same away from zero on either side
template <class R>
PD_HD R off_zero(const R& a) {
  const R none(scalar_of<R>(0)), least = above_zero(none);
  return select(size_of(a) < least, least, a);
}

template <class Law, int Numbers>
struct StretchLaw {
  static constexpr int corners = 4, dims = 3, constants = 0;
  static constexpr bool large = true;
  static constexpr int numbers = Numbers;  // w V, then those of the set

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[3], const R (&p)[Numbers], const R (&)[1],
                           Vec3<R> (&stress)[3], R& energy) {
    using Fixed = Still<R>;
    using Value = typename Fixed::Value;
    // only the numbers p may be dual
    Vec3<Value> column[3];
    for (int j = 0; j < 3; ++j)
      column[j] = {Fixed::value(f[j].x), Fixed::value(f[j].y), Fixed::value(f[j].z)};
    const Mat3<Value> whole = from_columns(column[0], column[1], column[2]);
    const Mat3<Value> rotation = nearest_rotation(whole);
    if constexpr (requires { Law::rests(whole, rotation, p); }) {
      if (!any(!Law::rests(whole, rotation, p))) {
        const R none(scalar_of<R>(0));
        for (int j = 0; j < 3; ++j) stress[j] = {none, none, none};
        return;
      }
    }
    const Stretches<Value> at(whole, rotation);
    R excess[3];
    Law::excess(at.s, p, excess);
    if (Energy) {
      const R square = multiply_add(excess[2], excess[2],
                                    multiply_add(excess[1], excess[1], excess[0] * excess[0]));
      energy = multiply_add(R(scalar_of<R>(0.5)) * p[0], square, energy);
    }
    for (int i = 0; i < 3; ++i) {
      const R weight = p[0] * excess[i];
      const Vec3<R> left = {Fixed::number(at.left[i].x), Fixed::number(at.left[i].y),
                            Fixed::number(at.left[i].z)};
      const R along[3] = {Fixed::number(at.right[i].x), Fixed::number(at.right[i].y),
                          Fixed::number(at.right[i].z)};
      for (int j = 0; j < 3; ++j) {
        const R part = weight * along[j];
        stress[j] = i == 0 ? part * left : multiply_add(part, left, stress[j]);
      }
    }
  }

  template <class R>
  PD_HD static void hessian(const Vec3<R> (&f)[3], const Vec3<R> (&df)[3], const R (&p)[Numbers],
                            const R (&)[1], Vec3<R> (&dp)[3]) {
    const R half(scalar_of<R>(0.5)), one(scalar_of<R>(1));
    const Mat3<R> whole = from_columns(f[0], f[1], f[2]);
    const Stretches<R> at(whole, nearest_rotation(whole));
    const typename Law::template Nearest<R> nearest(at.s, p);
    R m[3][3], own[3], moved[3];
    at.in_frame(from_columns(df[0], df[1], df[2]), m);
    for (int i = 0; i < 3; ++i) own[i] = m[i][i];
    nearest.change(own, moved);
    for (int i = 0; i < 3; ++i) m[i][i] = own[i] - moved[i];
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < i; ++j) {
        const R even = (half * (m[i][j] + m[j][i])) * (one - nearest.along(i, j));
        const R odd = (half * (m[i][j] - m[j][i])) * (one - nearest.across(i, j));
        m[i][j] = even + odd;
        m[j][i] = even - odd;
      }
    }
    const Mat3<R> change = transpose(p[0] * at.from_frame(m));
    for (int j = 0; j < 3; ++j) dp[j] = change.row[j];
  }

  template <class R>
  PD_HD static R weight(const R (&p)[Numbers], const R& l, const R&) {
    return p[0] * l;
  }
};

}  // namespace pd::inline PD_TARGET
