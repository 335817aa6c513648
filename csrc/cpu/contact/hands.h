// What moves by hand: colliders along their screws, pins of bodies along straight ways. Each takes the largest share of its
// way that is allowed.
#pragma once
#include "cpu/contact/pairs.h"
#include "math/screw.h"

namespace pd::inline PD_TARGET {

constexpr int share_halvings = 30;  // of the interval of a share

// The largest share in [0, 1] that is allowed, if 0 is, and with it all smaller ones.
template <class T, class Allowed>
T largest_share(const Allowed& allowed) {
  if (allowed(T(1))) return T(1);
  T least(0), most(1);
  for (int n = 0; n < share_halvings; ++n) {
    const T middle = T(0.5) * (least + most);
    (allowed(middle) ? least : most) = middle;
  }
  return least;
}

// A rigid body with given poses.
template <class T>
struct Hand {
  Pose<T> pose, goal;  // the actual one, and that of the step's end
  int begin, end;      // vertices

  bool is_there() const {
    const Vec3<T> way = goal.origin - pose.origin, turn = goal.axis - pose.axis;
    return way.x == T(0) && way.y == T(0) && way.z == T(0) && turn.x == T(0) && turn.y == T(0) &&
           turn.z == T(0) && goal.w == pose.w;
  }

  static Pose<T> read(const T* p) { return {{p[0], p[1], p[2]}, p[3], {p[4], p[5], p[6]}}; }
  static void write(const Pose<T>& pose, T* p) {
    p[0] = pose.origin.x, p[1] = pose.origin.y, p[2] = pose.origin.z, p[3] = pose.w;
    p[4] = pose.axis.x, p[5] = pose.axis.y, p[6] = pose.axis.z;
  }
};

template <class T>
Vec3<T> local_point(const ContactPlan<T>& plan, int vertex) {
  const T* p = plan.local + 3 * std::int64_t(vertex - plan.body_vertices);
  return {p[0], p[1], p[2]};
}

}  // namespace pd::inline PD_TARGET
