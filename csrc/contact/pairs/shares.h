// Shares of ways: of what moves by hand, colliders along their screws and pins of bodies along
// straight ways, and of whole bodies at the start of a step. Each takes the largest share of its
// way that is allowed.
#pragma once
#include "contact/pairs/pair.h"
#include "math/screw.h"
#include "math/svd.h"

namespace pd::inline PD_TARGET {

constexpr int share_halvings = 30;  // of the interval of a share

// The largest share in [0, 1] that is allowed, if 0 is, and with it all smaller ones.
template <class T, class Allowed>
PD_HD T largest_share(const Allowed& allowed, int halvings = share_halvings) {
  if (allowed(T(1))) return T(1);
  T least(0), most(1);
  for (int n = 0; n < halvings; ++n) {
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

  PD_HD bool is_there() const {
    const Vec3<T> way = goal.origin - pose.origin, turn = goal.axis - pose.axis;
    return way.x == T(0) && way.y == T(0) && way.z == T(0) && turn.x == T(0) && turn.y == T(0) &&
           turn.z == T(0) && goal.w == pose.w;
  }

  PD_HD static Pose<T> read(const T* p) { return {{p[0], p[1], p[2]}, p[3], {p[4], p[5], p[6]}}; }
  PD_HD static void write(const Pose<T>& pose, T* p) {
    p[0] = pose.origin.x, p[1] = pose.origin.y, p[2] = pose.origin.z, p[3] = pose.w;
    p[4] = pose.axis.x, p[5] = pose.axis.y, p[6] = pose.axis.z;
  }
};

template <class T>
PD_HD Vec3<T> local_point(const ContactPlan<T>& plan, int vertex) {
  const T* p = plan.local + 3 * std::int64_t(vertex - plan.body_vertices);
  return {p[0], p[1], p[2]};
}

// A direction with the largest gap at both ends, and the gap that must be kept along it: the floor,
// or the gap at the start where that is less. If no direction has it at both ends, the one with the
// largest gap at the start is taken.
template <class T>
struct Kept {
  Vec3<T> normal;
  T least;

  PD_HD bool allows(bool edges, const Vec3<T> (&corner)[4]) const {
    const T gap = gap_along(edges, normal, corner);
    return !(gap < least || gap <= gap_bound(corner));
  }
};

template <class T>
PD_HD Kept<T> direction_of(const ContactPair<T>& pair, const Vec3<T> (&start)[4],
                           const Vec3<T> (&end)[4]) {
  const bool edges = pair.edges;
  const Closest<T> first = closest_points(edges, start), last = closest_points(edges, end);
  Vec3<T> by_a{T(0), T(0), T(0)}, by_b = by_a, own = by_a, both = by_a;
  for (int a = 0; a < 4; ++a) {
    Vec3<T>& side = pair.on_a(a) ? by_a : by_b;
    side = side + (end[a] - start[a]);
  }
  const T on_a(edges ? 2 : 1), on_b(edges ? 2 : 3);
  const Vec3<T> relative = (T(1) / on_a) * by_a - (T(1) / on_b) * by_b;
  const T square = dot(relative, relative);
  const T share = dot(first.diff, relative) / (square > T(0) ? square : T(1));
  T largest = T(-HUGE_VAL), lower = T(-HUGE_VAL);
  const auto consider = [&](const Vec3<T>& normal) {
    const T before = gap_along(edges, normal, start), after = gap_along(edges, normal, end);
    const T smaller = before < after ? before : after;
    if (before > largest) largest = before, own = normal;
    if (smaller > lower) lower = smaller, both = normal;
  };
  each_candidate(edges, start, first, consider);
  visit_unit(subtract_product(first.diff, share, relative), consider);
  each_candidate(edges, end, last, consider);
  const T least = largest < pair.floor() ? largest : pair.floor();
  return {lower >= least ? both : own, least};
}

// Whether the parts of a pair stay apart along straight ways from `start` to `end`. `reach`: of its
// vertices, by how much their ways differ from a rigid motion.
template <class T, class Reach>
PD_HD bool stays_apart(const ContactPair<T>& pair, const Vec3<T> (&start)[4],
                       const Vec3<T> (&end)[4], const Reach& reach, T thickness) {
  ContactPair<T> at_start = pair;
  at_start.near = closest_points(pair.edges, start);
  if (!at_start.is_within(reach, thickness)) return true;
  const Kept<T> kept = direction_of(pair, start, end);
  const T gap = gap_along(pair.edges, kept.normal, end);
  return !(gap < kept.least) && kept.least > gap_bound(end);
}

constexpr double no_inertia = 1e-12;  // of the largest moment of a body: a line turns about itself

// The rigid part of the ways of a body, by its momenta.
struct RigidWay {
  double mass = 0;
  Vec3<double> center = {0, 0, 0}, mean = {0, 0, 0}, turn = {0, 0, 0};

  PD_HD Vec3<double> at(const Vec3<double>& place) const {
    return mean + cross(turn, place - center);
  }
};

// Adds a mass at an arm from the centre, with its way, to the moment of inertia and the angular momentum.
PD_HD void add_moment(double mass, const Vec3<double>& arm, const Vec3<double>& way,
                      Mat3<double>& moment, Vec3<double>& momentum) {
  momentum = multiply_add(mass, cross(arm, way), momentum);
  const double square = dot(arm, arm), at[3] = {arm.x, arm.y, arm.z};
  for (int r = 0; r < 3; ++r) {
    Vec3<double> row = {-at[r] * arm.x, -at[r] * arm.y, -at[r] * arm.z};
    (r == 0 ? row.x : r == 1 ? row.y : row.z) += square;
    moment.row[r] = multiply_add(mass, row, moment.row[r]);
  }
}

// moment^-1 momentum, 0 about axes without inertia
PD_HD Vec3<double> turn_of(const Mat3<double>& moment, const Vec3<double>& momentum) {
  const SignedSvd<double> svd = signed_svd(moment);
  const Mat3<double> axes = transpose(svd.u);
  Vec3<double> turn = {0, 0, 0};
  for (int n = 0; n < 3; ++n) {
    const double inertia = absolute(svd.s[n]);
    if (inertia > no_inertia * absolute(svd.s[0]))
      turn = multiply_add(dot(axes.row[n], momentum) / inertia, axes.row[n], turn);
  }
  return turn;
}

// The half-spaces of planes and spheres of the scene at a place, no deeper than the place: calls visit(normal, bound).
template <class T, class Visit>
PD_HD void each_wall(const Contacts<T>& contacts, const Vec3<T>& place, const Visit& visit) {
  const auto no_deeper = [&](const Vec3<T>& normal, T bound) {
    const T height = dot(normal, place);
    visit(normal, bound < height ? bound : height);
  };
  for (int n = 0; n < contacts.plane_count; ++n)
    no_deeper(contacts.planes[n].normal, contacts.planes[n].height);
  for (int n = 0; n < contacts.sphere_count; ++n) {
    const Sphere<T>& sphere = contacts.spheres[n];
    const Vec3<T> normal = outward(sphere, place);
    no_deeper(normal, dot(normal, sphere.center) + sphere.radius);
  }
}

}  // namespace pd::inline PD_TARGET
