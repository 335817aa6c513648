// Bodies that are thin about an axis, such as rods, in a coarse correction.
//
// A force beside the axis of a nearly straight rod turns it about itself by its displacement over that arm: many times
// round. No such motion is taken. So a turn about the axis is resisted, as by a mass that stays: X is added to
// sum a r r^T and to sum a (r + d) r^T, and tr X - tr(R X) >= 0 to the energy. It is 0 without motion: no fixed point
// moves. It does not depend on shifts: linear momentum is kept.
#pragma once
#include "solver/coarse/sums.h"

namespace pd::inline PD_TARGET {

constexpr double thin_share = 0.01;  // of sum a |r|^2: least moment of inertia about an axis

PD_HD void resist_thin_turns(RigidBody& body) {
  const SignedSvd<double> svd = signed_svd(body.second_moment);
  const double lacks =
      thin_share * trace(body.second_moment) - (absolute(svd.s[1]) + absolute(svd.s[2]));
  if (!(lacks > 0)) return;
  const Vec3<double> axis = {svd.u.row[0].x, svd.u.row[1].x, svd.u.row[2].x};
  const double along[3] = {axis.x, axis.y, axis.z}, half = 0.5 * lacks;
  for (int r = 0; r < 3; ++r) {
    Vec3<double> row = (-half * along[r]) * axis;
    (r == 0 ? row.x : r == 1 ? row.y : row.z) += half;
    body.covariance.row[r] = body.covariance.row[r] + row;
    body.second_moment.row[r] = body.second_moment.row[r] + row;
  }
}

}  // namespace pd::inline PD_TARGET
