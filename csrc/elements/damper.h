// Stiffness-proportional damping of a tetrahedron: mu beta / h |F - R U_t|^2, R the nearest rotation to F U_t.
//
// U_t is the stretch at the start of the step, F_t = R_t U_t, so a rigid rotation of the start feels no force and the
// axial stress is 2 mu beta (s - s_t) / h. h_T(F) = max tr(R^T F U_t) is convex, hence the weight 2 mu beta / h l_e. R
// is constant in the gradient. With T = U_t and W the derivative of the nearest rotation to F T along dF T,
//
//   dP = w (dF - W T),   d(P : dF) = -w sym(F^T W + R^T dF) : dT,   w = 2 mu beta / h
#pragma once
#include "elements/stencil.h"
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

struct Damper {
  static constexpr int corners = 4, dims = 3, constants = 0, rows = 3;
  static constexpr int memory = 6,
                       numbers = 1 + memory;  // 2 mu beta V / h; U_t: xx, yy, zz, xy, xz, yz
  static constexpr bool dissipates = true, large = true;

  template <class R>
  PD_HD static Mat3<R> matrix(const R* m) {
    return {{{m[0], m[3], m[4]}, {m[3], m[1], m[5]}, {m[4], m[5], m[2]}}};
  }
  // the numbers of the symmetric part
  template <class R>
  PD_HD static void store(const Mat3<R>& a, R* m) {
    const R half(scalar_of<R>(0.5));
    m[0] = a.row[0].x;
    m[1] = a.row[1].y;
    m[2] = a.row[2].z;
    m[3] = half * (a.row[0].y + a.row[1].x);
    m[4] = half * (a.row[0].z + a.row[2].x);
    m[5] = half * (a.row[1].z + a.row[2].y);
  }

  template <class R>
  PD_HD static void parameters(const R (&row)[3], const R& measure, R (&p)[numbers]) {
    const R &youngs = row[0], &poisson = row[1], &seconds = row[2];
    p[0] = measure * (youngs * seconds / (R(scalar_of<R>(1)) + poisson));
  }

  template <class R>
  PD_HD static void begin(const Vec3<R> (&f)[3], R (&m)[memory]) {
    const Mat3<R> start = from_columns(f[0], f[1], f[2]);
    store(transpose(nearest_rotation(start)) * start, m);
  }

  // The stress at the start that a slope by U_t, as a symmetric matrix, amounts to: of slope : dU_t along dF_t.
  template <class R>
  PD_HD static void begin_slope(const Vec3<R> (&f)[3], const R (&slope)[memory],
                                Vec3<R> (&stress)[3]) {
    const Mat3<R> start = from_columns(f[0], f[1], f[2]), r = nearest_rotation(start),
                  direct = r * matrix(slope);
    R m[memory];
    store(transpose(r) * start, m);
    const Mat3<R> turned = rotation_differential(start, r, direct * matrix(m));
    const Mat3<R> columns = transpose(direct - turned);
    for (int j = 0; j < 3; ++j) stress[j] = columns.row[j];
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[3], const R (&p)[numbers], const R (&)[1],
                           Vec3<R> (&stress)[3], R& energy) {
    using Fixed = Still<R>;
    using Value = typename Fixed::Value;
    // only the weight may be dual
    Value m[memory];
    for (int i = 0; i < memory; ++i) m[i] = Fixed::value(p[1 + i]);
    Vec3<Value> column[3];
    for (int j = 0; j < 3; ++j)
      column[j] = {Fixed::value(f[j].x), Fixed::value(f[j].y), Fixed::value(f[j].z)};
    const Mat3<Value> at = from_columns(column[0], column[1], column[2]), target = matrix(m);
    const Mat3<Value> apart = at - nearest_rotation(at * target) * target;
    if (Energy)
      energy =
          multiply_add(R(scalar_of<R>(0.5)) * p[0], Fixed::number(frobenius(apart, apart)), energy);
    const Mat3<Value> columns = transpose(apart);
    for (int j = 0; j < 3; ++j)
      stress[j] = p[0] * Vec3<R>{Fixed::number(columns.row[j].x), Fixed::number(columns.row[j].y),
                                 Fixed::number(columns.row[j].z)};
  }

  template <class R>
  PD_HD static void hessian(const Vec3<R> (&f)[3], const Vec3<R> (&df)[3], const R (&p)[numbers],
                            const R (&)[1], Vec3<R> (&dp)[3]) {
    const Mat3<R> target = matrix(p + 1), product = from_columns(f[0], f[1], f[2]) * target;
    const Mat3<R> d = from_columns(df[0], df[1], df[2]);
    const Mat3<R> turned = rotation_differential(product, nearest_rotation(product), d * target);
    const Mat3<R> columns = transpose(p[0] * (d - turned * target));
    for (int j = 0; j < 3; ++j) dp[j] = columns.row[j];
  }

  // Slope of P : dF by U_t, as a symmetric matrix.
  template <class R>
  PD_HD static void memory_slope(const Vec3<R> (&f)[3], const Vec3<R> (&df)[3],
                                 const R (&p)[numbers], const R (&)[1], R (&slope)[memory]) {
    const Mat3<R> target = matrix(p + 1), at = from_columns(f[0], f[1], f[2]);
    const Mat3<R> product = at * target, d = from_columns(df[0], df[1], df[2]);
    const Mat3<R> r = nearest_rotation(product),
                  turned = rotation_differential(product, r, d * target);
    Mat3<R> sum = transpose(at) * turned;
    const Mat3<R> other = transpose(r) * d;
    for (int i = 0; i < 3; ++i) sum.row[i] = sum.row[i] + other.row[i];
    store(-p[0] * sum, slope);
  }

  template <class R>
  PD_HD static R weight(const R (&p)[numbers], const R& l, const R&) {
    return p[0] * l;
  }
};

}  // namespace pd::inline PD_TARGET
