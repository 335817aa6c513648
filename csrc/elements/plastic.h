// Tetrahedron that flows: multiplicative plasticity, F = F_e Fp, with the corotated law of elements/corotated.h on F_e.
//
//   psi = mu |F_e - R|^2 + lambda phi(t),   t = R : (F_e - R),   F_e = F Fp^-1,   P = P_e Fp^-T
//
// Fp has determinant 1, and is constant within a step. Where a step ends, with F_e = U diag(s) V^T,
//
//   e = log s,   d = e - mean(e),   gamma = (|d| - (y + H alpha))+ / (1 + H) (1 - exp(-h / tau)),   D = V exp(gamma d / |d|) V^T
//   Fp <- D Fp / det(D Fp)^(1/3),   alpha <- alpha + gamma,   then the log of Fp's stretches is scaled down to |.| <= m
//
// for the yield strain e_y of a uniaxial test, y = sqrt(2/3) (1 + nu) e_y, hardening H, creep time tau, and largest flow
// m. Nothing flows where det F_e <= 0. D has determinant 1; the division keeps roundings from adding up over the steps.
#pragma once
#include "elements/corotated.h"
#include "elements/stencil.h"
#include "math/log_stretch.h"

namespace pd::inline PD_TARGET {

struct Plastic {
  static constexpr int corners = 4, dims = 3, constants = 0, history = 10;
  static constexpr int rows = 6 + history;  // E, nu, e_y, H, tau, m; Fp row by row, alpha
  static constexpr int numbers = 2 + 9;     // V 2 mu, V lambda; Fp^-1 row by row
  static constexpr bool keeps_axes = true, inverts = true;

  template <class R>
  PD_HD static Mat3<R> matrix(const R* m) {
    return {{{m[0], m[1], m[2]}, {m[3], m[4], m[5]}, {m[6], m[7], m[8]}}};
  }
  template <class R>
  PD_HD static void store(const Mat3<R>& a, R* m) {
    for (int i = 0; i < 3; ++i) {
      m[3 * i] = a.row[i].x;
      m[3 * i + 1] = a.row[i].y;
      m[3 * i + 2] = a.row[i].z;
    }
  }
  template <class R>
  PD_HD static Mat3<R> inverse(const Mat3<R>& a) {
    const Mat3<R> c = cofactor(a);
    return (R(scalar_of<R>(1)) / dot(a.row[0], c.row[0])) * transpose(c);
  }

  template <class R>
  PD_HD static void parameters(const R (&row)[rows], const R& measure, R (&p)[numbers]) {
    using T = scalar_of<R>;
    const R one(T(1)), two(T(2));
    const R &youngs = row[0], &poisson = row[1];
    p[0] = measure * (youngs / (one + poisson));
    p[1] = p[0] * (poisson / (one - two * poisson));
    store(inverse(matrix(row + 6)), p + 2);
  }

  template <class R>
  PD_HD static Mat3<R> metric(const R (&p)[numbers]) {
    return matrix(p + 2);
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[3], const R (&p)[numbers], const R (&)[1],
                           Vec3<R> (&stress)[3], R& energy) {
    const Mat3<R> flowed = metric(p), elastic = from_columns(f[0], f[1], f[2]) * flowed;
    const Mat3<R> strain = elastic - varying_rotation(elastic);
    const R trace[1] = {trace_strain(elastic, strain)}, weight[1] = {p[0]}, pressure[1] = {p[1]};
    const GroupTension<R> tension(trace, weight, pressure);
    if (Energy)
      energy = multiply_add(R(scalar_of<R>(0.5)) * p[0], frobenius(strain, strain),
                            multiply_add(p[1], tension.energy(), energy));
    const Mat3<R> own = corotated_stress(elastic, strain, p[0], p[1] * tension.slope);
    // the columns of P_e Fp^-T are the rows of Fp^-1 P_e^T
    const Mat3<R> columns = flowed * transpose(own);
    for (int j = 0; j < 3; ++j) stress[j] = columns.row[j];
  }

  template <class R>
  PD_HD static R weight(const R (&p)[numbers], const R& l, const R& n) {
    return multiply_add(n, greater(p[1], R(scalar_of<R>(0))), l * p[0]);
  }

  // The stiffness of F is at most that of F_e times the square of the largest stretch of Fp^-1.
  template <class R>
  PD_HD static R rest_weight(const R (&p)[numbers]) {
    const R one(scalar_of<R>(1));
    const Mat3<R> flowed = metric(p);
    return weight(p, one, one) * largest_eigenvalue(flowed * transpose(flowed));
  }

  template <class R>
  PD_HD static void finish(const Vec3<R> (&f)[3], const R (&row)[rows], const R& step,
                           R (&next)[history]) {
    const Mat3<R> before = matrix(row + 6);
    const Mat3<R> elastic = from_columns(f[0], f[1], f[2]) * inverse(before);
    R alpha = row[15];
    Mat3<R> after = before;
    if (R(scalar_of<R>(0)) < determinant(elastic)) flow(elastic, row, step, after, alpha);
    if (row[5] < R(scalar_of<R>(HUGE_VAL))) bound(row[5], after);
    store(after, next);
    next[9] = alpha;
  }

 private:
  template <class R>
  PD_HD static R length(const R (&a)[3]) {
    return square_root(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
  }

  // exp(factor a) in the frame of the stretches
  template <class R>
  PD_HD static Mat3<R> exponential_along(const LogStretch<R>& stretch, const R& factor,
                                         const R (&a)[3]) {
    const R along[3] = {factor * a[0], factor * a[1], factor * a[2]};
    return stretch.exponential_of(along, Still<R>::value(factor));
  }

  template <class R>
  PD_HD static void flow(const Mat3<R>& elastic, const R (&row)[rows], const R& step, Mat3<R>& fp,
                         R& alpha) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1)), third(T(1) / T(3)), norm(T(0.816496580927726033));
    const LogStretch<R> stretch(elastic);
    const R mean = third * (stretch.e[0] + stretch.e[1] + stretch.e[2]);
    const R d[3] = {stretch.e[0] - mean, stretch.e[1] - mean, stretch.e[2] - mean};
    const R size = length(d), yield = norm * ((one + row[1]) * row[2]) + row[3] * alpha;
    if (!(yield < size)) return;
    const R slow = one - exponential(-step / select(none < row[4], row[4], one));
    const R gamma = select(none < row[4], slow, one) * ((size - yield) / (one + row[3]));
    fp = exponential_along(stretch, gamma / size, d) * fp;
    fp = exponential(-third * logarithm(determinant(fp))) * fp;
    alpha = alpha + gamma;
  }

  template <class R>
  PD_HD static void bound(const R& most, Mat3<R>& fp) {
    const LogStretch<R> stretch(fp);
    const R size = length(stretch.e);
    if (!(most < size)) return;
    fp = fp * exponential_along(stretch, most / size - R(scalar_of<R>(1)), stretch.e);
  }
};

}  // namespace pd::inline PD_TARGET
