// What the elastic Hessian has of the positions, kept for many directions.
#pragma once
#include "cpu/step/workspace.h"
#include "elements/solid.h"

namespace pd::inline PD_TARGET {

// The rotation Jacobian of every element: nine numbers of the rotation and nine of the inverse, in blocks of lanes. With
// Poisson's ratio phi' and phi'' of its group follow.
template <class T>
class RotationJacobians {
  static constexpr int W = native_width<T>, rotation_numbers = 18;

 public:
  RotationJacobians(const Plan<T>& plan, bool tension)
      : numbers_(rotation_numbers + (tension ? 2 : 0)),
        storage_(allocate_zeroed(std::int64_t(plan.blocks) * block_lanes * numbers_ * sizeof(T))),
        data_(reinterpret_cast<T*>(storage_.get())) {}

  void set(const BlockPart<T>& part, const RotationJacobian<Pack<T, W>>& jacobian) {
    each(part, jacobian, [](auto& number, T* at) { number.store(at); });
  }
  RotationJacobian<Pack<T, W>> get(const BlockPart<T>& part) const {
    RotationJacobian<Pack<T, W>> jacobian;
    each(part, jacobian, [](auto& number, T* at) { number = Pack<T, W>::load(at); });
    return jacobian;
  }

  void set_tension(const BlockPart<T>& part, const GroupTension<Pack<T, W>>& tension) {
    tension.slope.store(of(part, rotation_numbers));
    tension.curvature().store(of(part, rotation_numbers + 1));
  }
  Pack<T, W> slope(const BlockPart<T>& part) const {
    return Pack<T, W>::load(of(part, rotation_numbers));
  }
  Pack<T, W> curvature(const BlockPart<T>& part) const {
    return Pack<T, W>::load(of(part, rotation_numbers + 1));
  }

 private:
  T* of(const BlockPart<T>& part, int number) const {
    return data_ + (std::int64_t(part.block) * numbers_ + number) * block_lanes + part.first_lane;
  }

  template <class Any, class Visit>
  void each(const BlockPart<T>& part, Any& jacobian, const Visit& visit) const {
    T* at = of(part, 0);
    for (auto* matrix : {&jacobian.rotation, &jacobian.inverse}) {
      for (auto& row : matrix->row) {
        for (auto* number : {&row.x, &row.y, &row.z}) {
          visit(*number, at);
          at += block_lanes;
        }
      }
    }
  }

  int numbers_;
  Storage storage_;
  T* data_;
};

// Keeps what the Hessian of every element has of the positions.
template <class T>
struct KeepJacobians {
  static constexpr int strip = 1;
  RotationJacobians<T>& jacobians;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    R trace[N];
    for (int s = 0; s < N; ++s) {
      Vec3<R> x[4];
      elements.corners(s, 0, x);
      const Mat3<R> f = deformation_gradient(x, elements.rest(s));
      const RotationJacobian<R> jacobian(f);
      jacobians.set(elements.part(s), jacobian);
      if constexpr (Grouped<Elements>)
        trace[s] = frobenius(jacobian.rotation, f - jacobian.rotation);
    }
    if constexpr (Grouped<Elements>) {
      R weight[N], pressure[N];
      for (int s = 0; s < N; ++s) {
        weight[s] = elements.weight(s);
        pressure[s] = elements.pressure(s);
      }
      static_assert(N == Elements::members);
      const GroupTension<R> tension(trace, weight, pressure);
      for (int s = 0; s < N; ++s) jacobians.set_tension(elements.part(s), tension);
    }
  }
};

// The Hessian of every element times field 1.
template <class T>
struct JacobianProduct {
  static constexpr int strip = 1;
  const RotationJacobians<T>& jacobians;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    if constexpr (Grouped<Elements>) return run_group<N>(elements);
    for (int s = 0; s < N; ++s) {
      Vec3<R> dx[4], g[4];
      elements.corners(s, 1, dx);
      solid_hessian_product(jacobians.get(elements.part(s)), dx, elements.rest(s),
                            elements.weight(s), g);
      elements.add(s, g);
    }
  }

  template <int N, class Elements>
  PD_HD void run_group(const Elements& elements) const {
    using R = typename Elements::R;
    Mat3<R> df[N];
    RotationJacobian<R> jacobian[N];
    R changes[N], pressure[N];
    for (int s = 0; s < N; ++s) {
      Vec3<R> dx[4];
      elements.corners(s, 1, dx);
      df[s] = deformation_gradient(dx, elements.rest(s));
      jacobian[s] = jacobians.get(elements.part(s));
      changes[s] = frobenius(jacobian[s].rotation, df[s]);
      pressure[s] = elements.pressure(s);
    }
    const R change = jacobians.curvature(elements.part(0)) * group_average(changes, pressure);
    const R slope = jacobians.slope(elements.part(0));
    for (int s = 0; s < N; ++s) {
      Vec3<R> g[4];
      corner_forces(
          corotated_stress_change(df[s], jacobian[s].rotation, jacobian[s].differential(df[s]),
                                  elements.weight(s), pressure[s] * slope, pressure[s] * change),
          elements.rest(s), g);
      elements.add(s, g);
    }
  }
};

}  // namespace pd::inline PD_TARGET
