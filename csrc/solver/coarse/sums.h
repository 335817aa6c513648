// Sums over the vertices of a body that say how E changes along its rigid motions, which strain nothing.
//
// With positions y = x + u, arms r = y - c from a centre c, ways d = s - u to the targets and a motion
// y -> c + R r + v, the quadratics of the vertices (solver/vertex.h) change by
//   sum a / 2 |u + (R - 1) r + v - s|^2 = const. - tr((R - 1)^T H) + W / 2 |v|^2 - v . sum a d,   H = sum a (r + d) r^T,
// where W = sum a and c is the mean of y by a (Kabsch 1976, Horn 1987). A body with pins turns about their mean, v = 0.
#pragma once
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

// In double. First those that give the mean of y; then the others, about that mean, so that far from the origin, or where
// a stiff spring outweighs all other vertices, nothing cancels. Those of pins are about the origin, and know nothing of y.
struct RigidSums {
  static constexpr int weight = 0, position = 1, target_offset = 4, second_moment = 7, turn = 13;
  static constexpr int pins = 22, pin_position = 23, pin_second_moment = 26, count = 32;
};

// Adds a vertex of weight a at y to the sums from `weight` on, over a and a y.
template <class W>
PD_HD void add_mean(W* sum, const W& a, const Vec3<W>& y) {
  sum[0] = sum[0] + a;
  sum[1] = multiply_add(a, y.x, sum[1]);
  sum[2] = multiply_add(a, y.y, sum[2]);
  sum[3] = multiply_add(a, y.z, sum[3]);
}

// Adds a vertex to the sums from `target_offset` on: a d; a r r^T; a d r^T, with r = `lever_arm`, d = `target_offset`.
template <class W>
PD_HD void add_moments(W* sum, const W& a, const Vec3<W>& lever_arm, const Vec3<W>& target_offset) {
  constexpr int second_moment = RigidSums::second_moment - RigidSums::target_offset,
                turn = RigidSums::turn - RigidSums::target_offset;
  const W at[3] = {lever_arm.x, lever_arm.y, lever_arm.z},
          way[3] = {a * target_offset.x, a * target_offset.y, a * target_offset.z};
  int n = second_moment;
  for (int r = 0; r < 3; ++r) {
    const W moment = a * at[r];
    sum[r] = sum[r] + way[r];
    for (int c = r; c < 3; ++c, ++n) sum[n] = multiply_add(moment, at[c], sum[n]);
    for (int c = 0; c < 3; ++c)
      sum[turn + 3 * r + c] = multiply_add(way[r], at[c], sum[turn + 3 * r + c]);
  }
}

// Adds a vertex that a pin holds at y (a = 0) to the sums from `pins` on: 1; y; y y^T.
template <class W>
PD_HD void add_pin(W* sum, const W& a, const Vec3<W>& y) {
  const W at[3] = {y.x, y.y, y.z}, pinned = select(a > W(0.0), W(0.0), W(1.0));
  sum[0] = sum[0] + pinned;
  int n = RigidSums::pin_second_moment - RigidSums::pins;
  for (int r = 0; r < 3; ++r) {
    const W held = pinned * at[r];
    sum[1 + r] = sum[1 + r] + held;
    for (int c = r; c < 3; ++c, ++n) sum[n] = multiply_add(held, at[c], sum[n]);
  }
}

// The mean of y, from the first sums.
PD_HD Vec3<double> center_of(const double* sum) {
  const double share = sum[0] > 0 ? 1.0 / sum[0] : 0.0;
  return {share * sum[1], share * sum[2], share * sum[3]};
}

PD_HD Mat3<double> symmetric(const double* s) {
  return {{{s[0], s[1], s[2]}, {s[1], s[3], s[4]}, {s[2], s[4], s[5]}}};
}

PD_HD double trace(const Mat3<double>& a) { return (a.row[0].x + a.row[1].y) + a.row[2].z; }

// Pins lie at one point that are no further apart than this share of their distance from the origin, which float32 rounds;
// and on one line that are no further from it than this share of what they are apart.
constexpr double one_point = 1e-6, one_line = 1e-4;

// What pins leave to a body.
enum class Hold { none, point, line, all };

// What the sums say: the centre, W, sum a d, H, sum a r r^T, the mean square of the arms, and the line of the pins.
struct RigidBody {
  Hold hold = Hold::none;
  double weight, square;
  Vec3<double> center, pull, axis = {0, 0, 0};
  Mat3<double> covariance, second_moment;

  RigidBody() = default;

  PD_HD explicit RigidBody(const double (&sum)[RigidSums::count])
      : weight(sum[RigidSums::weight]), center(center_of(sum)) {
    using S = RigidSums;
    pull = {sum[S::target_offset], sum[S::target_offset + 1], sum[S::target_offset + 2]};
    second_moment = symmetric(sum + S::second_moment);
    square = weight > 0 ? trace(second_moment) / weight : 0.0;
    const double* turn = sum + S::turn;
    for (int r = 0; r < 3; ++r)
      covariance.row[r] =
          second_moment.row[r] + Vec3<double>{turn[3 * r], turn[3 * r + 1], turn[3 * r + 2]};
    if (sum[S::pins] > 0) turn_about_pins(sum);
  }

 private:
  // The mean of the pins becomes the centre.
  PD_COLD void turn_about_pins(const double (&sum)[RigidSums::count]) {
    using S = RigidSums;
    const double share = 1.0 / sum[S::pins];
    const double* position = sum + S::pin_position;
    const double mean[3] = {share * position[0], share * position[1], share * position[2]};
    const Vec3<double> pins = {mean[0], mean[1], mean[2]};
    Mat3<double> spread = share * symmetric(sum + S::pin_second_moment);
    for (int r = 0; r < 3; ++r) spread.row[r] = subtract_product(spread.row[r], mean[r], pins);
    const SignedSvd<double> svd = signed_svd(spread);
    hold = !(svd.s[0] > one_point * one_point * dot(pins, pins)) ? Hold::point
           : svd.s[1] > one_line * one_line * svd.s[0]           ? Hold::all
                                                                 : Hold::line;
    axis = {svd.u.row[0].x, svd.u.row[1].x, svd.u.row[2].x};
    // arms are longer by -pivot: sum a r = -W pivot
    const Vec3<double> pivot = pins - center;
    const double way[3] = {pivot.x, pivot.y, pivot.z}, out[3] = {pull.x, pull.y, pull.z};
    for (int r = 0; r < 3; ++r) {
      const Vec3<double> moment = (weight * way[r]) * pivot;
      second_moment.row[r] = second_moment.row[r] + moment;
      covariance.row[r] = subtract_product(covariance.row[r] + moment, out[r], pivot);
    }
    center = pins;
    pull = {0, 0, 0};
  }
};

}  // namespace pd::inline PD_TARGET
