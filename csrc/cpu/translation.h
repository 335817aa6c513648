// Shifts of free pieces that minimise E along their translation: sum a (s - u) / sum a, as in exact arithmetic the
// momentum balance demands.
#pragma once
#include "cpu/workspace.h"

namespace pd::inline PD_TARGET {

template <class Lanes>
void find_shifts(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w) {
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  for (int g = 0; g < plan.groups; ++g) {
    w.group_weight[g] = Wide(0.0);
    for (int c = 0; c < 3; ++c) w.group_moment[3 * g + c] = Wide(0.0);
  }
  for (int i = 0; i < plan.vertices; ++i) {
    const int g = plan.vertex_group[i];
    if (g < 0) continue;
    const Wide a = Lanes::widen(w.inertia[i]);
    const Vec3<Real> lag = Lanes::vec3(w.target[i] - w.u[i]);
    w.group_weight[g] = w.group_weight[g] + a;
    w.group_moment[3 * g] = w.group_moment[3 * g] + a * Lanes::widen(lag.x);
    w.group_moment[3 * g + 1] = w.group_moment[3 * g + 1] + a * Lanes::widen(lag.y);
    w.group_moment[3 * g + 2] = w.group_moment[3 * g + 2] + a * Lanes::widen(lag.z);
  }
  for (int g = 0; g < plan.groups; ++g) {
    const auto mean = [&](int c) {
      return Lanes::narrow(w.group_moment[3 * g + c] / w.group_weight[g]);
    };
    w.shift[g] = Lanes::value({mean(0), mean(1), mean(2)});
  }
}

// a piece that the shift would leave touching a contact gets none
template <class Lanes>
void drop_touching_shifts(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                          const Contacts<typename Lanes::Real>& contacts) {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  const Real none(T(0)), one(T(1));
  for (int g = 0; g < plan.groups; ++g) w.group_weight[g] = Wide(1.0);
  for (int i = 0; i < plan.vertices; ++i) {
    const int g = plan.vertex_group[i];
    if (g < 0) continue;
    const Real least = contacts.least_gap(Lanes::vec3((w.x[i] + w.u[i]) + w.shift[g]));
    w.group_weight[g] = w.group_weight[g] * Lanes::widen(select(least > none, one, none));
  }
  for (int g = 0; g < plan.groups; ++g) w.shift[g] = Lanes::narrow(w.group_weight[g]) * w.shift[g];
}

}  // namespace pd::inline PD_TARGET
