// Closest points of a vertex and a triangle, and of two edges.
//
// A pair has four corners. Side A is a vertex (corner 0) and side B a triangle (1 2 3), or A is an
// edge (0 1) and B an edge (2 3). The closest points are the nearest of several candidates:
//
//   vertex and triangle  the vertex and each edge; the vertex and its foot inside the triangle
//   two edges            each end and the other edge; the inner solution
//
// The inner solution alone would be ill-defined for parallel edges.
#pragma once
#include "math/mat.h"

namespace pd::inline PD_TARGET {

template <class T>
struct Closest {
  T weight[4];   // of the corners: those of side A add up to 1, those of side B to -1
  Vec3<T> diff;  // from the point of B to that of A [m]
  T distance;    // |diff| [m]
};

// sum_a w_a x_a for weights that add up to zero, by differences of places. The sum of products
// would be wrong by an ulp of the place, which in float turns the direction of a small distance.
template <class T>
PD_HD Vec3<T> combined(const T (&weight)[4], const Vec3<T> (&corner)[4]) {
  const Vec3<T> first = weight[1] * (corner[1] - corner[0]);
  return multiply_add(weight[3], corner[3] - corner[0],
                      multiply_add(weight[2], corner[2] - corner[0], first));
}

// part / whole within [0, 1]; 0 for an edge without length, and a NaN stays NaN.
template <class T>
PD_HD T unit_share(T part, T whole) {
  const auto defined = whole > T(0);
  const T share = select(defined, part / select(defined, whole, T(1)), T(0));
  return select(share < T(0), T(0), select(share > T(1), T(1), share));
}

// The nearest to the origin among points of a triangle with corners `arm`; the first among equals.
template <class T>
struct NearestOfTriangle {
  T weight[3], square;  // of its distance [m^2]

  PD_HD NearestOfTriangle() : weight{T(1), T(0), T(0)}, square(T(HUGE_VAL)) {}

  PD_HD void consider(T a, T b, T c, const Vec3<T> (&arm)[3]) {
    consider(a, b, c, arm, T(0) <= T(0));
  }

  // where `allowed`
  template <class Mask>
  PD_HD void consider(T a, T b, T c, const Vec3<T> (&arm)[3], const Mask& allowed) {
    const Vec3<T> place = multiply_add(c, arm[2], multiply_add(b, arm[1], a * arm[0]));
    const T own = dot(place, place);
    const auto nearer = own < square && allowed;
    square = select(nearer, own, square);
    weight[0] = select(nearer, a, weight[0]);
    weight[1] = select(nearer, b, weight[1]);
    weight[2] = select(nearer, c, weight[2]);
  }
};

// Share of the edge start + s along at the foot of the origin.
template <class T>
PD_HD T foot_share(const Vec3<T>& start, const Vec3<T>& along) {
  return unit_share(-dot(start, along), dot(along, along));
}

// Weights of the triangle's point that is nearest to the vertex. With arms a_k from the vertex to
// the corners and the normal n, the foot on the plane has the weights n . (a_{k+1} x a_{k+2}) over
// their sum. The foot is inside where none of them is negative.
template <class T>
PD_HD void vertex_triangle_weights(const Vec3<T> (&corner)[4], T (&weight)[4]) {
  const T none(0), one(1);
  const Vec3<T> arm[3] = {corner[1] - corner[0], corner[2] - corner[0], corner[3] - corner[0]};
  const Vec3<T> side = corner[2] - corner[1], other_side = corner[3] - corner[1];
  NearestOfTriangle<T> nearest;
  T share = foot_share(arm[0], side);
  nearest.consider(one - share, share, none, arm);
  share = foot_share(arm[1], corner[3] - corner[2]);
  nearest.consider(none, one - share, share, arm);
  share = foot_share(arm[2], corner[1] - corner[3]);
  nearest.consider(share, none, one - share, arm);
  const Vec3<T> normal = cross(side, other_side);
  const T area[3] = {dot(cross(arm[1], arm[2]), normal), dot(cross(arm[2], arm[0]), normal),
                     dot(cross(arm[0], arm[1]), normal)};
  const T sum = (area[0] + area[1]) + area[2];
  const auto inside = none <= area[0] && none <= area[1] && none <= area[2] && none < sum;
  const T whole = select(inside, sum, one);
  nearest.consider(area[0] / whole, area[1] / whole, area[2] / whole, arm, inside);
  weight[0] = one;
  weight[1] = -nearest.weight[0];
  weight[2] = -nearest.weight[1];
  weight[3] = -nearest.weight[2];
}

// Let p = x_1 - x_0, q = x_3 - x_2 and r = x_0 - x_2. The points at shares s and t of the edges are
// r + s p - t q apart. Inside both edges the least distance has (Ericson 2005, section 5.1.9)
//
//   s = ((p.q) (q.r) - (p.r) (q.q)) / ((p.p) (q.q) - (p.q)^2) = (p x q).(q x r) / |p x q|^2
//   t = ((p.q) s + q.r) / q.q
//
// Shares end at 0 and 1. For nearly parallel edges the differences of products of dot products
// cancel: in float they miss a distance by 4e-4 of the edge. With cross products the error of s is
// an ulp over the sine of their angle. The distance is then right to an ulp at any angle.
template <class T>
PD_HD void edge_edge_weights(const Vec3<T> (&corner)[4], T (&weight)[4]) {
  const T none(0), one(1);
  const Vec3<T> p = corner[1] - corner[0], q = corner[3] - corner[2], r = corner[0] - corner[2];
  const T pp = dot(p, p), pq = dot(p, q), qq = dot(q, q), pr = dot(p, r), qr = dot(q, r);
  T s(0), t(0), least = T(HUGE_VAL);
  const auto consider = [&](T own_s, T own_t) {
    const Vec3<T> between = subtract_product(multiply_add(own_s, p, r), own_t, q);
    const T square = dot(between, between);
    const auto nearer = square < least;
    least = select(nearer, square, least);
    s = select(nearer, own_s, s);
    t = select(nearer, own_t, t);
  };
  consider(none, unit_share(qr, qq));
  consider(one, unit_share(qr + pq, qq));
  consider(unit_share(-pr, pp), none);
  consider(unit_share(pq - pr, pp), one);
  const Vec3<T> normal = exact_cross(p, q);
  const T inner = unit_share(dot(normal, exact_cross(q, r)), dot(normal, normal));
  const T across = unit_share(multiply_add(pq, inner, qr), qq);
  consider(unit_share(multiply_subtract(pq, across, pr), pp), across);
  weight[0] = one - s;
  weight[1] = s;
  weight[2] = t - one;
  weight[3] = -t;
}

// Closest points of a pair, of edges or of a vertex and a triangle.
template <class T>
PD_HD Closest<T> closest_points(bool edges, const Vec3<T> (&corner)[4]) {
  Closest<T> near;
  if (edges) {
    edge_edge_weights(corner, near.weight);
  } else {
    vertex_triangle_weights(corner, near.weight);
  }
  near.diff = combined(near.weight, corner);
  near.distance = square_root(dot(near.diff, near.diff));
  return near;
}

}  // namespace pd::inline PD_TARGET
