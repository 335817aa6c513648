// How far the parts of a body are from each other, without a search: by the distance from a rigid
// motion of its rest shape.
//
// Let l be the least distance at rest between parts that share no vertex. If no vertex is farther
// than e from a rigid motion of its place at rest, these parts are l - 2 e apart at least.
#pragma once
#include "contact/views.h"
#include "math/svd.h"

namespace pd::inline PD_TARGET {

constexpr double slack_share = 0.01;  // of the thickness, for rounding of what a search leaves out

template <class T>
class RestShapes {
 public:
  PD_HD explicit RestShapes(const ContactPlan<T>& plan) : plan_(plan) {}

  // Distance [m] that parts of a body have at least from each other; 0 or less: not known. All
  // threads of the group get it.
  template <class Group>
  PD_HD T apart(const Group& group, int body, const Vec3<T>* places) const {
    const T least = plan_.rest_apart[body];
    if (!(least > T(0))) return T(0);
    const int begin = plan_.surface_start[body], end = plan_.surface_start[body + 1];
    const Vec3<T> origin = places[plan_.point[begin]];
    // places at rest are about their middle, so that their sum is 0
    double sums[12] = {};
    group.sum_range(
        begin, end,
        [&](int n, double (&sum)[12]) {
          const int v = plan_.point[n];
          const Vec3<T> arm = places[v] - origin, rest = at_rest(v);
          const double of[3] = {double(arm.x), double(arm.y), double(arm.z)},
                       to[3] = {double(rest.x), double(rest.y), double(rest.z)};
          for (int r = 0; r < 3; ++r) {
            sum[r] += of[r];
            for (int c = 0; c < 3; ++c) sum[3 + 3 * r + c] += of[r] * to[c];
          }
        },
        sums);
    const double share = 1.0 / (end - begin);
    const Vec3<T> middle =
        origin + Vec3<T>{T(share * sums[0]), T(share * sums[1]), T(share * sums[2])};
    const Mat3<T> turn = rotation_by_svd(Mat3<T>{{{T(sums[3]), T(sums[4]), T(sums[5])},
                                                  {T(sums[6]), T(sums[7]), T(sums[8])},
                                                  {T(sums[9]), T(sums[10]), T(sums[11])}}});
    double most[1] = {0};  // the least of - square
    group.least_range(
        begin, end,
        [&](int n, double (&low)[1]) {
          const int v = plan_.point[n];
          const Vec3<T> off = (places[v] - middle) - turn * at_rest(v);
          const double square = double(dot(off, off));
          if (!(-square >= low[0])) low[0] = square < HUGE_VAL ? -square : -HUGE_VAL;
        },
        most);
    return least - T(2) * square_root(T(-most[0]));
  }

 private:
  PD_HD Vec3<T> at_rest(int vertex) const {
    const T* p = plan_.rest + 3 * std::int64_t(vertex);
    return {p[0], p[1], p[2]};
  }

  const ContactPlan<T>& plan_;
};

}  // namespace pd::inline PD_TARGET
