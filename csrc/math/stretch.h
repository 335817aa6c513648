// Signed stretches of a matrix, without branches over lanes, so that a lane of a pack has the bits of a scalar.
//
//   F = R S,   R the nearest rotation,   S = V diag(s) V^T symmetric,   U = R V:   F = U diag(s) V^T
//
// s are the singular values, the smallest with the sign of det F: any two of them add up to at least zero.
#pragma once
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

template <class R>
PD_HD R greater(const R& a, const R& b) {
  return -lesser(-a, -b);
}
template <class R>
PD_HD R size_of(const R& a) {
  return greater(a, -a);
}

// A symmetric matrix and the rotation V that has diagonalised it so far.
template <class R>
struct JacobiState {
  R a[3][3], v[3][3];

  PD_HD R largest_off() const {
    return greater(size_of(a[0][1]), greater(size_of(a[0][2]), size_of(a[1][2])));
  }

  // One Jacobi rotation: makes a_pq zero, unless it is negligible beside `least`.
  PD_HD void rotate(int p, int q, const R& least) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), two(T(2));
    const int r = 3 - p - q;
    const R off = a[p][q], apart = a[q][q] - a[p][p];
    // tan of the angle, the smaller root: at most one
    const R root = square_root(multiply_add(apart, apart, R(T(4)) * (off * off)));
    const R under = select(apart < none, apart - root, apart + root);
    const auto goes = least < size_of(off);
    const R slope = select(goes, two * off / select(none < size_of(under), under, one), none);
    const R tangent = lesser(one, -lesser(one, -slope));
    const R c = one / square_root(multiply_add(tangent, tangent, one)), s = c * tangent;
    a[p][p] = subtract_product(a[p][p], tangent, off);
    a[q][q] = multiply_add(tangent, off, a[q][q]);
    a[p][q] = a[q][p] = select(goes, none, off);
    const R rp = a[r][p], rq = a[r][q];
    a[r][p] = a[p][r] = subtract_product(c * rp, s, rq);
    a[r][q] = a[q][r] = multiply_add(s, rp, c * rq);
    for (int i = 0; i < 3; ++i) {
      const R vp = v[i][p], vq = v[i][q];
      v[i][p] = subtract_product(c * vp, s, vq);
      v[i][q] = multiply_add(s, vp, c * vq);
    }
  }
};

// The largest eigenvalue of a symmetric matrix.
template <class R>
PD_CALLED void find_largest_eigenvalue(const Mat3<R>& m, R& found) {
  using T = scalar_of<R>;
  const R none(T(0)), one(T(1));
  const Vec3<R>(&row)[3] = m.row;
  JacobiState<R> state = {{{row[0].x, row[0].y, row[0].z},
                           {row[0].y, row[1].y, row[1].z},
                           {row[0].z, row[1].z, row[2].z}},
                          {{one, none, none}, {none, one, none}, {none, none, one}}};
  const R least = R(T(0.125) * epsilon<T>()) * (size_of(row[0].x) + size_of(row[1].y) +
                                                (size_of(row[2].z) + state.largest_off()));
  for (int round = 0; round < 8; ++round) {
    if (!any(least < state.largest_off())) break;
    state.rotate(0, 1, least);
    state.rotate(0, 2, least);
    state.rotate(1, 2, least);
  }
  found = greater(state.a[0][0], greater(state.a[1][1], state.a[2][2]));
}
template <class R>
PD_HD R largest_eigenvalue(const Mat3<R>& m) {
  R found;
  find_largest_eigenvalue(m, found);
  return found;
}

template <class R>
struct Stretches;

template <class R>
PD_CALLED void find_stretches(const Mat3<R>& f, const Mat3<R>& rotation, Stretches<R>& found) {
  using T = scalar_of<R>;
  const R none(T(0)), one(T(1)), half(T(0.5));
  const Mat3<R> product = transpose(rotation) * f;
  const Vec3<R>(&row)[3] = product.row;
  const R xy = half * (row[0].y + row[1].x), xz = half * (row[0].z + row[2].x),
          yz = half * (row[1].z + row[2].y);
  JacobiState<R> state = {{{row[0].x, xy, xz}, {xy, row[1].y, yz}, {xz, yz, row[2].z}},
                          {{one, none, none}, {none, one, none}, {none, none, one}}};
  const R largest = (size_of(row[0].x) + size_of(row[1].y)) +
                    (size_of(row[2].z) + (size_of(xy) + (size_of(xz) + size_of(yz))));
  const R least = R(T(0.125) * epsilon<T>()) * largest;
  // Lanes that are done rotate by nothing, which changes no bit.
  for (int round = 0; round < 8; ++round) {
    if (!any(least < state.largest_off())) break;
    state.rotate(0, 1, least);
    state.rotate(0, 2, least);
    state.rotate(1, 2, least);
  }
  for (int i = 0; i < 3; ++i) {
    found.s[i] = state.a[i][i];
    found.right[i] = {state.v[0][i], state.v[1][i], state.v[2][i]};
    found.left[i] = rotation * found.right[i];
  }
}

// U, V and s of F, in no order. F that is not finite gives NaN.
template <class R>
struct Stretches {
  Vec3<R> left[3], right[3];  // columns of U and of V
  R s[3];

  // from F and its nearest rotation
  PD_HD Stretches(const Mat3<R>& f, const Mat3<R>& rotation) { find_stretches(f, rotation, *this); }

  // U^T A V
  PD_HD void in_frame(const Mat3<R>& a, R (&m)[3][3]) const {
    for (int j = 0; j < 3; ++j) {
      const Vec3<R> column = a * right[j];
      for (int i = 0; i < 3; ++i) m[i][j] = dot(left[i], column);
    }
  }
  // U M V^T
  PD_HD Mat3<R> from_frame(const R (&m)[3][3]) const {
    Mat3<R> sum;
    for (int j = 0; j < 3; ++j) {
      const Vec3<R> u =
          multiply_add(m[2][j], left[2], multiply_add(m[1][j], left[1], m[0][j] * left[0]));
      const Mat3<R> part = {{u.x * right[j], u.y * right[j], u.z * right[j]}};
      for (int i = 0; i < 3; ++i) sum.row[i] = j == 0 ? part.row[i] : sum.row[i] + part.row[i];
    }
    return sum;
  }
};

}  // namespace pd::inline PD_TARGET
