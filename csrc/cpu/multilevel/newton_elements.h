// The positive part of every element's Hessian, for solver Newton: products with directions, and blocks of its diagonal.
#pragma once
#include "cpu/adjoint/rotation_jacobians.h"
#include "cpu/multilevel/piece_elements.h"

namespace pd::inline PD_TARGET {

// Keeps R^T and the twists of every tetrahedron (PieceFrame), as a rotation and an inverse.
template <class T>
struct KeepFrames {
  static constexpr int strip = 1;
  RotationJacobians<T>& frames;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    const R none(T(0)), one(T(1));
    Mat3<R> f[N], rotation[N];
    R share[N];
    for (int s = 0; s < N; ++s) {
      Vec3<R> x[4];
      elements.corners(s, 0, x);
      f[s] = deformation_gradient(x, elements.rest(s));
      rotation[s] = nearest_rotation(f[s]);
      share[s] = one;
    }
    if constexpr (Grouped<Elements>) {
      R trace[N], weight[N], pressure[N];
      for (int s = 0; s < N; ++s) {
        trace[s] = frobenius(rotation[s], f[s] - rotation[s]);
        weight[s] = elements.weight(s);
        pressure[s] = elements.pressure(s);
      }
      static_assert(N == Elements::members);
      const GroupTension<R> tension(trace, weight, pressure);
      for (int s = 0; s < N; ++s) {
        frames.set_tension(elements.part(s), tension);
        const R known = select(none < weight[s], weight[s], one);
        share[s] = one - pressure[s] * tension.slope / known;
      }
    }
    for (int s = 0; s < N; ++s) {
      const PieceFrame<R> frame(f[s], rotation[s], share[s]);
      RotationJacobian<R> kept;
      kept.rotation = frame.back;
      for (int k = 0; k < 3; ++k) kept.inverse.row[k] = frame.twist[k];
      frames.set(elements.part(s), kept);
    }
  }
};

// dP R^T / 2 mu V along dF, without volume: the strain, and what twists cost. `change`: V lambda times that of the trace.
template <class R>
PD_HD Mat3<R> positive_stress(const RotationJacobian<R>& kept, const Mat3<R>& df, const R& weight,
                              const R& change) {
  const R half(scalar_of<R>(0.5));
  const Mat3<R> d = df * kept.rotation;
  const Vec3<R> axis = {d.row[2].y - d.row[1].z, d.row[0].z - d.row[2].x, d.row[1].x - d.row[0].y};
  Vec3<R> v = dot(kept.inverse.row[0], axis) * kept.inverse.row[0];
  for (int k = 1; k < 3; ++k)
    v = multiply_add(dot(kept.inverse.row[k], axis), kept.inverse.row[k], v);
  const R xy = half * (d.row[0].y + d.row[1].x), xz = half * (d.row[0].z + d.row[2].x),
          yz = half * (d.row[1].z + d.row[2].y);
  const Mat3<R> stress = {
      {{multiply_add(weight, d.row[0].x, change), weight * (xy - v.z), weight * (xz + v.y)},
       {weight * (xy + v.z), multiply_add(weight, d.row[1].y, change), weight * (yz - v.x)},
       {weight * (xz - v.y), weight * (yz + v.x), multiply_add(weight, d.row[2].z, change)}}};
  return stress * transpose(kept.rotation);
}

// The positive part of the Hessian times field 1.
template <class T>
struct PositiveProduct {
  static constexpr int strip = 1;
  const RotationJacobians<T>& frames;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    Mat3<R> df[N];
    RotationJacobian<R> kept[N];
    R change[N];
    for (int s = 0; s < N; ++s) {
      Vec3<R> dx[4];
      elements.corners(s, 1, dx);
      df[s] = deformation_gradient(dx, elements.rest(s));
      kept[s] = frames.get(elements.part(s));
      change[s] = R(T(0));
    }
    if constexpr (Grouped<Elements>) {
      R traces[N], pressure[N];
      for (int s = 0; s < N; ++s) {
        traces[s] = frobenius(transpose(kept[s].rotation), df[s]);
        pressure[s] = elements.pressure(s);
      }
      const R mean = frames.curvature(elements.part(0)) * group_average(traces, pressure);
      for (int s = 0; s < N; ++s) change[s] = pressure[s] * mean;
    }
    for (int s = 0; s < N; ++s) {
      Vec3<R> g[4];
      corner_forces(positive_stress(kept[s], df[s], elements.weight(s), change[s]),
                    elements.rest(s), g);
      elements.add(s, g);
    }
  }
};

// Column `axis` of the diagonal blocks of elements with n corners, times n: their sum bounds the Hessian. The trace of a
// group costs at most what the traces of its members would.
template <class T>
struct BlockColumn {
  static constexpr int strip = 1;
  const RotationJacobians<T>& frames;
  int axis;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    const R none(T(0)), one(T(1)), n(T(4));
    const Vec3<R> unit = {axis == 0 ? one : none, axis == 1 ? one : none, axis == 2 ? one : none};
    for (int s = 0; s < N; ++s) {
      const RotationJacobian<R> kept = frames.get(elements.part(s));
      Vec3<R> own[4];
      for (int c = 0; c < 4; ++c) {
        Vec3<R> dx[4], g[4];
        for (int a = 0; a < 4; ++a) dx[a] = a == c ? unit : Vec3<R>{none, none, none};
        const Mat3<R> df = deformation_gradient(dx, elements.rest(s));
        R change = none;
        if constexpr (Grouped<Elements>)
          change = frames.curvature(elements.part(s)) *
                   (elements.pressure(s) * frobenius(transpose(kept.rotation), df));
        corner_forces(positive_stress(kept, df, elements.weight(s), change), elements.rest(s), g);
        own[c] = n * g[c];
      }
      elements.add(s, own);
    }
  }
};

// Forces of stencils on their corners as these move by dx.
template <class Kind, class R, class Own>
PD_HD void positive_forces(const R (&second)[3 * Kind::dims][3 * Kind::dims], const Own& own,
                           const Vec3<R> (&dx)[Kind::corners], Vec3<R> (&force)[Kind::corners]) {
  Vec3<R> df[Kind::dims], dp[Kind::dims];
  deform<Kind>(dx, own.g, df);
  const auto row = [&](int r) {
    R sum(scalar_of<R>(0));
    for (int j = 0; j < Kind::dims; ++j) {
      sum = multiply_add(second[r][3 * j], df[j].x, sum);
      sum = multiply_add(second[r][3 * j + 1], df[j].y, sum);
      sum = multiply_add(second[r][3 * j + 2], df[j].z, sum);
    }
    return sum;
  };
  for (int j = 0; j < Kind::dims; ++j) dp[j] = {row(3 * j), row(3 * j + 1), row(3 * j + 2)};
  stencil_forces<Kind>(dp, own.g, force);
}

struct PositiveStencils {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilNumbers<Kind, Stencils> own(stencils);
    Vec3<R> x[Kind::corners], force[Kind::corners], f[Kind::dims];
    R second[3 * Kind::dims][3 * Kind::dims];
    stencils.corners(0, x);
    deform<Kind>(x, own.g, f);
    positive_second_derivative<Kind>(f, own, second);
    stencils.corners(1, x);
    positive_forces<Kind>(second, own, x, force);
    stencils.add(force);
  }
};

struct StencilBlockColumn {
  int axis;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    using T = scalar_of<R>;
    constexpr int n = Kind::corners;
    const R none(T(0)), one(T(1));
    const Vec3<R> unit = {axis == 0 ? one : none, axis == 1 ? one : none, axis == 2 ? one : none};
    const StencilNumbers<Kind, Stencils> own(stencils);
    Vec3<R> x[n], column[n], force[n], f[Kind::dims];
    R second[3 * Kind::dims][3 * Kind::dims];
    stencils.corners(0, x);
    deform<Kind>(x, own.g, f);
    positive_second_derivative<Kind>(f, own, second);
    for (int c = 0; c < n; ++c) {
      for (int a = 0; a < n; ++a) x[a] = a == c ? unit : Vec3<R>{none, none, none};
      positive_forces<Kind>(second, own, x, force);
      column[c] = R(T(n)) * force[c];
    }
    stencils.add(column);
  }
};

}  // namespace pd::inline PD_TARGET
