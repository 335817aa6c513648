// A pair of parts of surfaces that may come near: a vertex and a triangle, or two edges. Which pairs count, and what a
// pair does in a step.
#pragma once
#include "contact/pairs/half_space.h"
#include "contact/pairs/multiplier.h"
#include "contact/pairs/separation.h"
#include "contact/views.h"

#include <cstdint>

namespace pd::inline PD_TARGET {

constexpr double floor_share = 0.1;   // least distance of the promise over the thickness
constexpr int contact_sweeps = 8;     // in an iteration: with 4 an edge on an edge cycles
constexpr int search_pause = 5;       // least iterations between searches
constexpr double ball_reach = 1.2;    // of what a vertex wants; see ball_cells
constexpr double ball_room = 0.49;    // of the room to the nearest other side
constexpr double ball_cells = 0.25;   // most radius of a ball, over the mean edge
constexpr double least_yield = 1e-6;  // of the weights of a pair, on vertices that move freely

// `Places` and `Inverse` below are arrays of vertices.
template <class T>
struct ContactPair {
  int vertex[4];
  bool edges;
  std::int64_t key;
  T thickness, friction;
  PairPlane<T> plane = {};
  Multiplier<T> force = {};
  // at the present iterate
  Closest<T> near = {};
  Vec3<T> normal = {};

  PD_HD T floor() const { return T(floor_share) * thickness; }
  PD_HD bool on_a(int corner) const { return corner <= (edges ? 1 : 0); }

  template <class Places>
  PD_HD void corners(const Places& places, Vec3<T> (&out)[4]) const {
    for (int a = 0; a < 4; ++a) out[a] = places[vertex[a]];
  }

  PD_HD bool has_force() const {
    const Vec3<T>& t = force.tangential;
    return force.normal > T(0) || t.x != T(0) || t.y != T(0) || t.z != T(0);
  }

  // sum w^2 / D
  template <class Inverse>
  PD_HD T yielding(const Inverse& inverse) const {
    T sum(0);
    for (int a = 0; a < 4; ++a)
      sum = multiply_add(near.weight[a] * near.weight[a], inverse[vertex[a]], sum);
    return sum;
  }

  // weight on vertices that move freely
  template <class Inverse>
  PD_HD T freedom(const Inverse& inverse) const {
    T sum(0);
    for (int a = 0; a < 4; ++a)
      if (inverse[vertex[a]] > T(0)) sum = sum + absolute(near.weight[a]);
    return sum;
  }

  template <class Inverse>
  PD_HD bool can_yield(const Inverse& inverse) const {
    return freedom(inverse) > T(least_yield);
  }

  PD_HD Vec3<T> normal_at(const Closest<T>& at) const {
    return at.distance > T(1e-9) ? (T(1) / at.distance) * at.diff : plane.normal;
  }
  // Takes them as those of the present iterate.
  PD_HD void look(const Closest<T>& at) { near = at, normal = normal_at(at); }

  // between two places, along the surface
  template <class Places>
  PD_HD Vec3<T> slip(const Places& places, const Places& begin, const Closest<T>& at) const {
    Vec3<T> moved[4];
    for (int a = 0; a < 4; ++a) moved[a] = places[vertex[a]] - begin[vertex[a]];
    return tangential(combined(at.weight, moved), normal_at(at));
  }

  // Whether d <= b_A + b_B + r, with b of a side the largest of its vertices.
  template <class Radius>
  PD_HD bool is_within(const Radius& radius, T thickness) const {
    T reach[2] = {T(0), T(0)};
    for (int a = 0; a < 4; ++a) {
      T& side = reach[on_a(a) ? 0 : 1];
      const T own = radius(vertex[a]);
      side = side < own ? own : side;
    }
    return near.distance <= reach[0] + reach[1] + thickness;
  }
};

// Keys grow with the first part of a pair, then with the second; vertices and triangles come first.
template <class T>
PD_HD ContactPair<T> pair_of_point(const ContactPlan<T>& plan, int vertex, int triangle) {
  const int* corner = plan.triangle + 3 * triangle;
  return {{vertex, corner[0], corner[1], corner[2]},
          false,
          std::int64_t(vertex) * plan.triangles + triangle,
          T(0),
          T(0)};
}
template <class T>
PD_HD std::int64_t first_edge_key(const ContactPlan<T>& plan) {
  return std::int64_t(plan.vertices) * plan.triangles;
}
template <class T>
PD_HD ContactPair<T> pair_of_edges(const ContactPlan<T>& plan, int first, int second) {
  const int *a = plan.edge + 2 * first, *b = plan.edge + 2 * second;
  return {{a[0], a[1], b[0], b[1]},
          true,
          first_edge_key(plan) + std::int64_t(first) * plan.edges + second,
          T(0),
          T(0)};
}

// The place of a number in an increasing array, or where it would be.
PD_HD std::int64_t find_sorted(const std::int64_t* numbers, std::int64_t count,
                               std::int64_t number) {
  std::int64_t begin = 0, end = count;
  while (begin < end) {
    const std::int64_t middle = (begin + end) / 2;
    if (numbers[middle] < number) {
      begin = middle + 1;
    } else {
      end = middle;
    }
  }
  return begin;
}

// Fills in thickness and friction; returns whether the pair counts. `friction`: [bodies, bodies]; `held(vertex)`: moves by
// hand.
template <class T, class Held>
PD_HD bool complete(const ContactPlan<T>& plan, const T* friction, const Held& held,
                    ContactPair<T>& pair) {
  const int* v = pair.vertex;
  const int split = pair.edges ? 2 : 1;
  for (int a = 0; a < split; ++a) {
    for (int b = split; b < 4; ++b)
      if (v[a] == v[b]) return false;
  }
  const int first = plan.body[v[0]], last = plan.body[v[3]];
  if (first == last && !plan.touches_itself[first]) return false;
  if (held(v[0]) && held(v[1]) && held(v[2]) && held(v[3])) return false;
  pair.thickness = plan.thickness;
  const std::int64_t at = find_sorted(plan.rest_key, plan.rest_pairs, pair.key);
  if (at < plan.rest_pairs && plan.rest_key[at] == pair.key)
    pair.thickness = plan.rest_thickness[at];
  if (!(pair.thickness > T(0))) return false;  // a tie joins the sides, of one body or of two
  pair.friction = friction[std::int64_t(first) * plan.bodies + last];
  return true;
}

// Makes the plane of a pair at `places`, whose vertices want to go to `want`.
template <class T, class Places>
PD_HD void make_plane(ContactPair<T>& pair, const Places& places, const Places& want,
                      const Closest<T>& near, const Vec3<T>& hand) {
  Vec3<T> corner[4], goal[4];
  pair.corners(places, corner);
  pair.corners(want, goal);
  pair.plane =
      divide(pair.edges, corner, goal, pair.floor(), separate(pair.edges, corner, near, hand));
}

// The side of the plane of a pair on which a corner stays: calls visit(normal, bound, margin).
template <class T, class Visit>
PD_HD void visit_space(const PairPlane<T>& plane, bool on_a, const Visit& visit) {
  if (on_a) {
    visit(plane.normal, plane.above, plane.margin);
  } else {
    visit(-plane.normal, -plane.below, plane.margin);
  }
}

// Whether the plane must be made anew, for targets that it does not let pass.
template <class T, class Places>
PD_HD bool breaks(const ContactPair<T>& pair, const Places& target) {
  bool broken = pair.plane.frozen;
  for (int a = 0; a < 4; ++a) {
    const T height = dot(pair.plane.normal, target[pair.vertex[a]]);
    broken = broken || (pair.on_a(a) ? height < pair.plane.above : height > pair.plane.below);
  }
  return broken;
}

}  // namespace pd::inline PD_TARGET
