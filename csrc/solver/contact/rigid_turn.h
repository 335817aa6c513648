// The turn of a collider with a mass in a step, and the torque that its momentum takes: see solver/contact/rigid.h.
#pragma once
#include "math/screw.h"

namespace pd::inline PD_TARGET {

// Of the compliance 1 / W: that of the vertices of a collider, which bounds beta where nothing else yields.
constexpr double rigid_yield = 1e-3;
constexpr double half_turn = 1e-9;  // least cosine of half of a turn

// Cayley's vector of the smaller turn from one orientation to another. R may be dual numbers.
template <class R>
PD_HD Vec3<R> turn_between(const Quaternion<R>& begin, const Quaternion<R>& end) {
  const Quaternion<R> q = end * Quaternion<R>{begin.w, -begin.axis};
  const bool flips = q.w < R(0.0);
  const R w = flips ? -q.w : q.w, sign = R(flips ? -2.0 : 2.0);
  return (sign / (w > R(half_turn) ? w : R(half_turn))) * q.axis;
}

// (1 + [u] / 2 + u u^T / 4) (L - J u) after a turn u.
template <class R>
PD_HD Vec3<R> torque_after(const Vec3<R>& turn, const Mat3<R>& inertia, const Vec3<R>& momentum) {
  const Vec3<R> left = momentum - inertia * turn;
  return multiply_add(R(0.25) * dot(turn, left), turn,
                      multiply_add(R(0.5), cross(turn, left), left));
}

}  // namespace pd::inline PD_TARGET
