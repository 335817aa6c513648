// The local step of projective dynamics: the rotation nearest to a deformation gradient (polar decomposition).
//
// R = argmax over rotations of tr(R^T F). The maximum is the largest root of Davenport's quartic (Markley 1993, FOAM)
//   p(l) = (l^2 - |F|^2)^2 - 8 det(F) l - 4 |cof F|^2.
// Newton's method finds the root from above, since sqrt(3) |F| >= the sum of the singular values. Then in closed form
//   R = ((k + |F|^2) F - F F^T F + l cof F) / (k l - det F),   k = (l^2 - |F|^2) / 2,
// because every invariant of F F^T is one of F's. det R = +1, so an inverted element resists. The method has no state
// and no trigonometry. The rotation is ill-defined near a double root (s_2 + s_3 ~ 0 with the sign of det F on s_3);
// there a singular value decomposition replaces the closed form.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"
#include "math/svd.h"

namespace pd::inline PD_TARGET {

template <class R>
struct Invariants {
  R norm2, cofactor2, det;
};

template <class R>
PD_HD Invariants<R> invariants(const Mat3<R>& f) {
  const Mat3<R> c = cofactor(f);
  return {frobenius(f, f), frobenius(c, c), dot(f.row[0], c.row[0])};
}

template <class R>
struct Root {
  R value, slope, change;  // l, p'(l) / 4 before the last step, four times the size of that step
};

template <class R>
PD_HD Root<R> newton(const Invariants<R>& i, const R& l) {
  const R u = multiply_subtract(l, l, i.norm2);
  const R p = multiply_subtract(u, u, multiply_add(R(8) * i.det, l, R(4) * i.cofactor2));
  const R slope = multiply_subtract(l, u, R(2) * i.det);
  const R change = p * rough_reciprocal(slope);
  return {subtract_product(l, R(0.25), change), slope, change};
}

// A Newton step of relative size t leaves an error of about 2 t^2. These t, times four, leave it below the rounding.
template <class T>
PD_HD constexpr T newton_tolerance() {
  return sizeof(T) == 4 ? T(4e-4) : T(12e-9);
}

// Two steps suffice for strains up to 0.11 in float32. Lanes that need more continue alone, so that no lane depends
// on its neighbours.
template <class R>
PD_HD Root<R> largest_root(const Invariants<R>& i) {
  using T = scalar_of<R>;
  constexpr int first = sizeof(T) == 4 ? 2 : 4;
  Root<R> root = {rough_square_root(R(3) * i.norm2), R(0), R(0)};
  for (int step = 0; step < first; ++step) root = newton(i, root.value);
  auto far = root.change > R(newton_tolerance<T>()) * root.value;
  for (int step = 0; step < 9 && any(far); ++step) {
    const Root<R> next = newton(i, root.value);
    root = {select(far, next.value, root.value), select(far, next.slope, root.slope),
            select(far, next.change, root.change)};
    far = root.change > R(newton_tolerance<T>()) * root.value;
  }
  return root;
}

// (a I + b F F^T) F + c cof F
template <class R>
PD_HD Mat3<R> combine(const Mat3<R>& f, const R& a, const R& b, const R& c) {
  const R xy = b * dot(f.row[0], f.row[1]), xz = b * dot(f.row[0], f.row[2]);
  const R yz = b * dot(f.row[1], f.row[2]);
  const Mat3<R> s = {{{multiply_add(b, dot(f.row[0], f.row[0]), a), xy, xz},
                      {xy, multiply_add(b, dot(f.row[1], f.row[1]), a), yz},
                      {xz, yz, multiply_add(b, dot(f.row[2], f.row[2]), a)}}};
  const Mat3<R> cofactors = cofactor(f);
  Mat3<R> sum;
  for (int r = 0; r < 3; ++r) sum.row[r] = multiply_add(c, cofactors.row[r], s.row[r] * f);
  return sum;
}

// R = diagonal F - scale F F^T F + twist cof F
template <class R>
struct ClosedForm {
  R scale, diagonal, twist;

  PD_HD ClosedForm(const Invariants<R>& i, const R& l) {
    const R k = R(0.5) * multiply_subtract(l, l, i.norm2);
    scale = reciprocal(multiply_subtract(k, l, i.det));
    diagonal = (k + i.norm2) * scale;
    twist = l * scale;
  }
};

template <class R>
PD_HD Mat3<R> rotation_from_root(const Mat3<R>& f, const Invariants<R>& i, const R& l) {
  const ClosedForm<R> form(i, l);
  return combine(f, form.diagonal, -form.scale, form.twist);
}

// The closed form is accurate while p'(l) is not small against |F|^2 l (4 * 1.8 at rest, 0 at a double root).
template <class R>
PD_HD auto trusted(const Invariants<R>& i, const Root<R>& root) {
  using T = scalar_of<R>;
  return root.slope > R(T(0.025)) * i.norm2 * root.value && i.norm2 > R(T(1e-12)) &&
         i.norm2 < R(T(1e12));
}

// F and R pass by value, so that the hot path may keep them in registers.
template <class T>
PD_COLD Mat3<T> safe_rotation(Mat3<T> f) {
  return rotation_by_svd(f);
}

PD_HD void repair_rotation(const Mat3<float>& f, bool, Mat3<float>& r) { r = safe_rotation(f); }
PD_HD void repair_rotation(const Mat3<double>& f, bool, Mat3<double>& r) { r = safe_rotation(f); }

// weight (F - R) from the root. This takes fewer operations than forming R, and has no larger errors below stretches
// of 2.
template <class R>
PD_HD Mat3<R> finish_strain(const Mat3<R>& f, const Invariants<R>& i, const Root<R>& root,
                            const R& weight) {
  const ClosedForm<R> form(i, root.value);
  Mat3<R> strain = combine(f, weight * (R(scalar_of<R>(1)) - form.diagonal), weight * form.scale,
                           -weight * form.twist);
  const auto good = trusted(i, root);
  if (any(!good)) [[unlikely]] {
    Mat3<R> r = f;
    repair_rotation(f, good, r);
    strain = select(good, strain, weight * (f - r));
  }
  return strain;
}

template <class R>
PD_HD Mat3<R> nearest_rotation(const Mat3<R>& f) {
  const Invariants<R> i = invariants(f);
  const Root<R> root = largest_root(i);
  Mat3<R> r = rotation_from_root(f, i, root.value);
  const auto good = trusted(i, root);
  if (any(!good)) [[unlikely]] {
    repair_rotation(f, good, r);
  }
  return r;
}

// tr(S) I - S for the symmetric part of S: the second derivative of tr(R^T F) under a small rotation of R.
template <class R>
PD_HD Mat3<R> axis_matrix(const Mat3<R>& s) {
  const R trace = s.row[0].x + s.row[1].y + s.row[2].z;
  const R minus_half(scalar_of<R>(-0.5));
  const R xy = minus_half * (s.row[0].y + s.row[1].x);
  const R xz = minus_half * (s.row[0].z + s.row[2].x);
  const R yz = minus_half * (s.row[1].z + s.row[2].y);
  return {
      {{trace - s.row[0].x, xy, xz}, {xy, trace - s.row[1].y, yz}, {xz, yz, trace - s.row[2].z}}};
}

// Solves (tr(S) I - S) x = axis for the rotation vector x.
template <class R>
PD_HD Vec3<R> solve_axis(const Mat3<R>& s, const Vec3<R>& axis) {
  const Mat3<R> h = axis_matrix(s), c = cofactor(h);
  return (R(scalar_of<R>(1)) / dot(h.row[0], c.row[0])) * (c * axis);
}

// the vector of A - A^T
template <class R>
PD_HD Vec3<R> axis_of(const Mat3<R>& a) {
  return {a.row[2].y - a.row[1].z, a.row[0].z - a.row[2].x, a.row[1].x - a.row[0].y};
}

template <class R>
PD_HD Mat3<R> cross_matrix(const Vec3<R>& a) {
  const R none(scalar_of<R>(0));
  return {{{none, -a.z, a.y}, {a.z, none, -a.x}, {-a.y, a.x, none}}};
}

// Derivative of the nearest rotation along dF: dR = R [h]_x with (tr(S) I - S) h = axis(R^T dF), S = R^T F symmetric,
// axis(A) the vector of A - A^T. The map is self-adjoint, so it serves jvp and vjp alike. It is infinite where s_2 +
// s_3 = 0 (sign of det F on s_3), where the nearest rotation jumps.
template <class R>
PD_HD Mat3<R> rotation_differential(const Mat3<R>& f, const Mat3<R>& r, const Mat3<R>& df) {
  const Mat3<R> rt = transpose(r);
  return r * cross_matrix(solve_axis(rt * f, axis_of(rt * df)));
}

// The part of this derivative that depends on F alone, for many directions: R, and the inverse of tr(S) I - S.
template <class R>
struct RotationJacobian {
  Mat3<R> rotation, inverse;

  RotationJacobian() = default;

  PD_HD explicit RotationJacobian(const Mat3<R>& f) : rotation(nearest_rotation(f)) {
    const Mat3<R> h = axis_matrix(transpose(rotation) * f), c = cofactor(h);
    inverse = (R(scalar_of<R>(1)) / dot(h.row[0], c.row[0])) * c;
  }

  PD_HD Mat3<R> differential(const Mat3<R>& df) const {
    return rotation * cross_matrix(inverse * axis_of(transpose(rotation) * df));
  }
};

// One Newton step on the rotation group, then one Newton-Schulz step back onto it: accurate to the last bits.
template <class R>
PD_HD Mat3<R> polished_rotation(const Mat3<R>& f) {
  using T = scalar_of<R>;
  const Invariants<R> i = invariants(f);
  const auto good = trusted(i, largest_root(i));
  const Mat3<R> r = nearest_rotation(f);
  const Mat3<R> s = transpose(r) * f;
  const Mat3<R> turn = cross_matrix(solve_axis(s, axis_of(s)));
  Mat3<R> turned = r * turn;
  for (int a = 0; a < 3; ++a) turned.row[a] = turned.row[a] + r.row[a];
  const Mat3<R> metric = transpose(turned) * turned;
  Mat3<R> schulz = R(T(-0.5)) * metric;
  schulz.row[0].x = schulz.row[0].x + R(T(1.5));
  schulz.row[1].y = schulz.row[1].y + R(T(1.5));
  schulz.row[2].z = schulz.row[2].z + R(T(1.5));
  return select(good, turned * schulz, r);
}

}  // namespace pd::inline PD_TARGET
