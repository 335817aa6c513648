// The positive part of every tetrahedron's Hessian, for solver Newton: products with directions, and blocks of its diagonal.
#pragma once
#include "cpu/adjoint/rotation_jacobians.h"
#include "cpu/multilevel/stencil_hessians.h"
#include "elements/solid.h"
#include "solver/multilevel/pieces.h"

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
    const R none(T(0)), one(T(1)), half(T(0.5));
    const Vec3<R> unit = {axis == 0 ? one : none, axis == 1 ? one : none, axis == 2 ? one : none};
    for (int s = 0; s < N; ++s) {
      const RotationJacobian<R> kept = frames.get(elements.part(s));
      const R weight = R(T(4)) * elements.weight(s);
      R trace = none;
      if constexpr (Grouped<Elements>)
        trace = R(T(4)) * (frames.curvature(elements.part(s)) * elements.pressure(s));
      Vec3<R> gradient[4], own[4];
      shape_gradients(elements.rest(s), gradient);
      for (int c = 0; c < 4; ++c) {
        // dF R^T = unit h^T
        const Vec3<R> h = gradient[c] * kept.rotation, axial = cross(h, unit);
        Vec3<R> twist = dot(kept.inverse.row[0], axial) * kept.inverse.row[0];
        for (int k = 1; k < 3; ++k)
          twist = multiply_add(dot(kept.inverse.row[k], axial), kept.inverse.row[k], twist);
        const R along = dot(h, unit), square = half * dot(h, h);
        const Vec3<R> strained = multiply_add(half * along, h, square * unit) + cross(twist, h);
        own[c] = multiply_add(trace * along, h, weight * strained);
      }
      elements.add(s, own);
    }
  }
};

// What is kept of an iterate.
template <class T>
struct NewtonWork {
  RotationJacobians<T> frames;  // of tetrahedra: R^T and the twists
  StencilHessians<T> hessians;

  NewtonWork(const Plan<T>& plan, bool tension) : frames(plan, tension), hessians(plan) {}
};

}  // namespace pd::inline PD_TARGET
