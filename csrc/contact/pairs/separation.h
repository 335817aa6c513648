// A plane between the two sides of a pair, certified by the corners themselves.
//
// For a unit direction n let a = min over side A of n . x, b = max over side B, and gap = a - b. A
// positive gap separates the convex hulls of both sides. Two numbers c_A - c_B >= f then bound all
// later places: n . x >= c_A on side A and n . x <= c_B on side B keep the hulls f apart. Straight
// displacements between two such states do so too, because the set is convex.
#pragma once
#include "contact/pairs/closest.h"
#include "contact/pairs/half_space.h"

namespace pd::inline PD_TARGET {

template <class T>
struct Separation {
  Vec3<T> normal;  // unit, toward side A; zero where all corners coincide
  T gap, bound;    // a - b [m], and the bound of its rounding [m]
};

// Half-spaces of a pair: n . x >= above on side A, n . x <= below on side B.
template <class T>
struct PairPlane {
  Vec3<T> normal;  // toward side A
  T above, below;  // c_A, c_B [m]
  T margin;        // rounding of n . x [m]
  bool frozen;     // no direction separates the sides beyond rounding: their vertices must not move
};

// a - b along a direction, from differences of places.
template <class T>
PD_HD T gap_along(bool edges, const Vec3<T>& normal, const Vec3<T> (&corner)[4]) {
  const T first = dot(normal, corner[1] - corner[0]), second = dot(normal, corner[2] - corner[0]),
          third = dot(normal, corner[3] - corner[0]);
  const T of_edge = select(second < third, third, second);
  const T on_a = select(edges, lesser(T(0), first), T(0));
  const T on_b = select(edges || first < of_edge, of_edge, first);
  return on_a - on_b;
}

// `vector` without its part along an edge, if the closest point lies inside that edge.
template <class T>
PD_HD Vec3<T> without_part(const Vec3<T>& vector, const Vec3<T>& along, bool carries) {
  const T square = dot(along, along);
  const T share = dot(vector, along) / select(square > T(0), square, T(1));
  return select(carries, subtract_product(vector, share, along), vector);
}

// `diff` orthogonal to the edges in whose inside the closest points lie; twice, for two edges.
// Rounding turns `diff` by an ulp over the distance, which over the length of an edge is more than
// the gap.
template <class T>
PD_HD Vec3<T> squared_diff(bool edges, const Vec3<T> (&corner)[4], const Closest<T>& near) {
  const bool in[4] = {near.weight[0] != T(0), near.weight[1] != T(0), near.weight[2] != T(0),
                      near.weight[3] != T(0)};
  Vec3<T> diff = near.diff;
  if (edges) {
    const Vec3<T> first = corner[1] - corner[0], second = corner[3] - corner[2];
    for (int round = 0; round < 2; ++round) {
      diff = without_part(diff, first, in[0] && in[1]);
      diff = without_part(diff, second, in[2] && in[3]);
    }
  } else {
    diff = without_part(diff, corner[2] - corner[1], in[1] && in[2] && !in[3]);
    diff = without_part(diff, corner[3] - corner[2], in[2] && in[3] && !in[1]);
    diff = without_part(diff, corner[1] - corner[3], in[3] && in[1] && !in[2]);
  }
  return diff;
}

// The face's normal, or the common normal of two edges, toward side A.
template <class T>
PD_HD Vec3<T> common_normal(bool edges, const Vec3<T> (&corner)[4], const Vec3<T>& diff) {
  const Vec3<T> first = select(edges, corner[1] - corner[0], corner[2] - corner[1]);
  const Vec3<T> normal = exact_cross(first, corner[3] - corner[2]);
  return select(dot(normal, diff) < T(0), -normal, normal);
}

// Calls visit(unit vector) along a vector that has a length.
template <class T, class Visit>
PD_HD void visit_unit(const Vec3<T>& vector, const Visit& visit) {
  const T length = square_root(dot(vector, vector));
  if (length > T(0)) visit((T(1) / length) * vector);
}

// Calls visit(normal) for unit directions that may separate the sides: between the closest points;
// the same orthogonal to the edges that carry these; the face's or the common normal.
template <class T, class Visit>
PD_HD void each_candidate(bool edges, const Vec3<T> (&corner)[4], const Closest<T>& near,
                          const Visit& visit) {
  visit_unit(near.diff, visit);
  visit_unit(squared_diff(edges, corner, near), visit);
  visit_unit(common_normal(edges, corner, near.diff), visit);
}

// The bound of the rounding of a gap: 4 eps of the largest |x_a - x_0|_1.
template <class T>
PD_HD T gap_bound(const Vec3<T> (&corner)[4]) {
  T reach(0);
  PD_UNROLL
  for (int a = 1; a < 4; ++a) {
    const T own = sum_of_sizes(corner[a] - corner[0]);
    reach = select(own > reach, own, reach);
  }
  return T(4) * epsilon<T>() * reach;
}

// The direction of the largest gap among the candidates and the direction at hand, zero for none.
template <class T>
PD_HD Separation<T> separate(bool edges, const Vec3<T> (&corner)[4], const Closest<T>& near,
                             const Vec3<T>& hand) {
  const T none(0);
  Separation<T> best = {{none, none, none}, T(-HUGE_VAL), gap_bound(corner)};
  const auto consider = [&](const Vec3<T>& normal) {
    const T gap = gap_along(edges, normal, corner);
    const bool larger = gap > best.gap;
    best.normal = select(larger, normal, best.normal);
    best.gap = select(larger, gap, best.gap);
  };
  each_candidate(edges, corner, near, consider);
  visit_unit(hand, consider);
  return best;
}

// The plane at corners that want to go to `want`. The sides divide the gap beyond the floor f in
// the ratio of their approaches; each takes at least a twentieth:
//
//   gap >= f + 2 mg:  c_B = b + s (gap - f - 2 mg),  c_A = c_B + f + 2 mg
//   else:             c_B = b - mg,                  c_A = a + mg
//
// s is the share of B in the approach, and the margin mg the rounding of n . x. Below the floor the
// sides may part or slide, but not come nearer.
template <class T>
PD_HD PairPlane<T> divide(bool edges, const Vec3<T> (&corner)[4], const Vec3<T> (&want)[4], T floor,
                          const Separation<T>& of) {
  const T none(0);
  T least = T(HUGE_VAL), most = T(-HUGE_VAL), by_a(0), by_b(0), margin(0);
  PD_UNROLL
  for (int a = 0; a < 4; ++a) {
    const bool on_a = a == 0 || (a == 1 && edges);
    const T height = dot(of.normal, corner[a]), move = dot(of.normal, want[a] - corner[a]),
            rounding = place_rounding(corner[a]);
    least = select(on_a && height < least, height, least);
    most = select(!on_a && height > most, height, most);
    by_a = select(on_a && -move > by_a, -move, by_a);
    by_b = select(!on_a && move > by_b, move, by_b);
    margin = select(rounding > margin, rounding, margin);
  }
  const T both = by_a + by_b;
  const T part = select(both > none, by_b / select(both > none, both, T(1)), T(0.5));
  const T share = select(part < T(0.05), T(0.05), lesser(part, T(0.95)));
  const T apart = multiply_add(T(2), margin, floor);
  const bool roomy = of.gap >= apart;
  const T below = select(roomy, multiply_add(share, of.gap - apart, most), most - margin);
  const T above = select(roomy, below + apart, least + margin);
  return {of.normal, above, below, margin, !(of.gap > of.bound)};
}

}  // namespace pd::inline PD_TARGET
