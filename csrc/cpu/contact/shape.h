// How far the parts of a body are from each other, without a search: by the distance from a rigid motion of its rest shape.
//
// Let l be the least distance at rest between parts that share no vertex. If no vertex is farther than e from a rigid motion
// of its place at rest, these parts are l - 2 e apart at least.
#pragma once
#include "contact/views.h"
#include "math/svd.h"

#include <vector>

namespace pd::inline PD_TARGET {

constexpr double slack_share = 0.01;  // of the thickness, for rounding of what a search leaves out

template <class T>
class RestShapes {
 public:
  explicit RestShapes(const ContactPlan<T>& plan) : plan_(plan), begin_(plan.bodies + 1) {
    int n = 0;
    for (int b = 0; b < plan.bodies; ++b) {
      begin_[b] = n;
      while (n < plan.points && plan.body[plan.point[n]] == b) ++n;
    }
    begin_[plan.bodies] = n;
  }

  // calls visit(vertex) for those of a body's surface
  template <class Visit>
  void each_of(int body, const Visit& visit) const {
    for (int n = begin_[body]; n < begin_[body + 1]; ++n) visit(plan_.point[n]);
  }

  bool has_surface(int body) const { return begin_[body] < begin_[body + 1]; }

  bool moves_by_hand(int body) const {
    return !has_surface(body) || plan_.point[begin_[body]] >= plan_.body_vertices;
  }

  // Distance [m] that parts of a body have at least from each other; 0 or less: not known.
  T apart(int body, const std::vector<Vec3<T>>& places) const {
    const T least = plan_.rest_apart[body];
    if (!(least > T(0))) return T(0);
    Vec3<T> center{T(0), T(0), T(0)};
    each_of(body,
            [&](int v) { center = center + (places[v] - places[plan_.point[begin_[body]]]); });
    center = multiply_add(T(1) / T(begin_[body + 1] - begin_[body]), center,
                          places[plan_.point[begin_[body]]]);
    Mat3<T> sum{};
    each_of(body, [&](int v) {
      const Vec3<T> arm = places[v] - center, rest = at_rest(v);
      sum.row[0] = multiply_add(arm.x, rest, sum.row[0]);
      sum.row[1] = multiply_add(arm.y, rest, sum.row[1]);
      sum.row[2] = multiply_add(arm.z, rest, sum.row[2]);
    });
    const Mat3<T> turn = rotation_by_svd(sum);
    T most(0);
    bool finite = true;
    each_of(body, [&](int v) {
      const Vec3<T> off = (places[v] - center) - turn * at_rest(v);
      const T square = dot(off, off);
      finite = finite && square < T(HUGE_VAL);
      most = square > most ? square : most;
    });
    return finite ? least - T(2) * square_root(most) : T(0);
  }

 private:
  Vec3<T> at_rest(int vertex) const {
    const T* p = plan_.rest + 3 * std::int64_t(vertex);
    return {p[0], p[1], p[2]};
  }

  const ContactPlan<T>& plan_;
  std::vector<int> begin_;  // [bodies + 1] of its surface in plan.point
};

}  // namespace pd::inline PD_TARGET
