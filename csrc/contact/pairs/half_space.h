// The nearest allowed place of a vertex: in its ball, and in the half-spaces of its pairs and of
// the scene.
//
// All sets are convex, so a state in them and the straight displacement to it from another are free
// of crossings. The vertex is projected on the half-spaces that it violates, one after another, in
// up to four rounds, then into its ball. The rest of the violation shortens its displacement from
// the present place, which is allowed.
#pragma once
#include "math/vec.h"

namespace pd::inline PD_TARGET {

constexpr int projection_rounds = 4;     // 1 and 16 end alike
constexpr double ball_tolerance = 1e-6;  // relative to the radius

// The ball of a vertex around its place at the last search.
template <class T>
struct Ball {
  Vec3<T> center;
  T radius;  // [m]; HUGE_VAL: everywhere
};

template <class T>
struct LimitedPlace {
  Vec3<T> place;
  bool shortened;  // half-spaces cut the displacement
};

// |x|_1
template <class T>
PD_HD T sum_of_sizes(const Vec3<T>& x) {
  return (absolute(x.x) + absolute(x.y)) + absolute(x.z);
}

// Rounding of n . x at a place x [m]: 2 eps |x|_1.
template <class T>
PD_HD T place_rounding(const Vec3<T>& x) {
  return T(2) * epsilon<T>() * sum_of_sizes(x);
}

// Projects a place into the ball; returns whether it was outside.
template <class T>
PD_HD bool move_into(const Ball<T>& ball, Vec3<T>& place) {
  const Vec3<T> arm = place - ball.center;
  const T square = dot(arm, arm);
  if (square <= ball.radius * ball.radius) return false;
  const T length = square_root(square);
  const bool outside = length > ball.radius * T(1.0 + ball_tolerance);
  if (outside) place = multiply_add(ball.radius / length, arm, ball.center);
  return outside;
}

// The allowed place of a vertex that wants to go from `from` to `target`.
//
// spaces(visit) calls visit(normal, bound, margin) for the half-spaces normal . x >= bound of the
// vertex in their order. The share of the displacement that remains is the largest that no
// half-space forbids, with a_i = n_i . x - (c_i - mg) before and after:
//
//   share = min over a_i(after) < 0 of  max(0, a_i(before)) / (max(0, a_i(before)) - a_i(after))
//
// The result is in the half-spaces to their margins and a rounding of its own. A target that
// violates none, and is in the ball, keeps its bits.
template <class T, class Spaces>
PD_HD LimitedPlace<T> limit(const Vec3<T>& target, const Vec3<T>& from, const Ball<T>& ball,
                            const Spaces& spaces) {
  Vec3<T> place = target;
  move_into(ball, place);
  bool projected = false, moved = true;
  for (int round = 0; moved && round < projection_rounds; ++round) {
    moved = false;
    spaces([&](const Vec3<T>& normal, T bound, T) {
      const T slack = dot(normal, place) - bound;
      if (!(slack < T(0))) return;
      place = subtract_product(place, slack, normal);
      moved = projected = true;
    });
  }
  if (!projected) return {place, false};
  move_into(ball, place);
  T share(1);
  spaces([&](const Vec3<T>& normal, T bound, T margin) {
    const T least = bound - margin;
    const T after = dot(normal, place) - least, before = dot(normal, from) - least;
    if (!(after < T(0))) return;
    const T room = select(before < T(0), T(0), before);
    share = lesser(share, room / (room - after));
  });
  const bool shortened = share < T(1);
  if (shortened) place = multiply_add(share, place - from, from);
  return {place, shortened};
}

// Whether a place is in the ball and in all half-spaces, to their margins.
template <class T, class Spaces>
PD_HD bool is_allowed(const Vec3<T>& place, const Ball<T>& ball, const Spaces& spaces) {
  Vec3<T> inside = place;
  bool allowed = !move_into(ball, inside);
  spaces([&](const Vec3<T>& normal, T bound, T margin) {
    allowed = allowed && !(dot(normal, place) - bound < -margin);
  });
  return allowed;
}

}  // namespace pd::inline PD_TARGET
