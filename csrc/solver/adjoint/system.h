// The system of a step's adjoint, H l = dL/dx' + dL/dv' / h on the free directions, and the gradient by the state
// before the step; see torchpd/ops/adjoint.py. One vertex at a time, without neighbours.
#pragma once
#include "contact/plane_sphere.h"
#include "math/mat.h"
#include "solver/vertex.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// Relative residual at which a solve stops: near the rounding floor of each precision.
template <class T>
constexpr double adjoint_tolerance = sizeof(T) == 4 ? 1e-5 : 1e-10;
// A solve has failed above this multiple of the tolerance.
constexpr double adjoint_failed = 1e3;
constexpr int adjoint_iterations = 2000;  // at most

// Slip below this share of what friction could take back counts as none.
constexpr double sticking_tolerance = 1e-3;

// A contact at one vertex.
template <class T>
struct ContactAt {
  int number;  // planes, then spheres
  Vec3<T> normal;
  T gap, friction;
  Vec3<T> motion;
  T inverse_distance;  // 1 / distance to the centre of a sphere; 0 for planes
};

// The contacts that hold a vertex of a solved step. A contact holds it if a plain iteration, x' - r / D, would
// penetrate.
template <class T>
struct HeldVertex {
  Vec3<T> position;  // x'
  Vec3<T> moved;     // x' - x
  Vec3<T> residual;  // r, the gradient of the step's objective
  T diagonal;

  // projector off the normals that hold it
  Mat3<T> projector = {{{T(1), T(0), T(0)}, {T(0), T(1), T(0)}, {T(0), T(0), T(1)}}};
  bool stuck = false;  // friction holds it
  int sticks_to = -1;  // friction of this contact, the last if there are several
  T carried = T(1);    // its motion along the surface per motion of its start
  T curvature = T(0);  // normal force times curvature of the surface that it slides on
  int contacts = 0;    // holding contacts
  Vec3<T> first_normal = {};
  T first_friction = T(0);
  Vec3<T> slides[slide_count] = {};

  // Returns whether the contact holds the vertex along a normal that earlier contacts do not span. A contact whose
  // normal they span adds nothing.
  PD_HD bool add_contact(const ContactAt<T>& contact) {
    const Vec3<T>&normal = contact.normal, &motion = contact.motion;
    const T friction = contact.friction, inverse_distance = contact.inverse_distance;
    const T normal_force = dot(residual, normal);
    if (!(normal_force > T(0) && contact.gap < normal_force / diagonal)) return false;
    // orthogonalised, so that the product stays a projector
    const Vec3<T> left = projector * normal;
    const T size = dot(left, left);
    if (!(size > T(dependent_normal))) return false;
    projector = project_off(projector, left, T(1) / size);
    const Vec3<T> slip = tangential(moved - motion, normal);
    const T slipped = square_root(dot(slip, slip));
    const bool sticks = friction > T(0) && holds(slipped, friction * normal_force);
    stuck = stuck || sticks;
    if (sticks) sticks_to = contact.number;
    curvature = multiply_add(normal_force, inverse_distance, curvature);
    for (Vec3<T>& of : slides) of = {T(0), T(0), T(0)};
    ++contacts;
    carried = T(1);
    if (contacts == 1) {
      first_normal = normal;
      first_friction = friction;
      // its end is where the line from the centre to its start, moved along, meets the sphere
      const T begins = T(1) - inverse_distance * dot(moved - motion, normal);
      if (sticks && begins > T(0)) carried = T(1) / begins;
      if (friction > T(0) && !sticks)
        slide_on(normal, normal_force, friction, motion, inverse_distance, slip, slipped);
    } else if (contacts == 2 && curvature == T(0)) {
      slide_along_edge(normal, friction);
    }
    return true;
  }

  // friction can take back more in one iteration than has slipped
  PD_HD bool holds(T slipped, T most) const {
    return slipped * diagonal <= T(sticking_tolerance) * most;
  }

  PD_HD void slide_on(const Vec3<T>& normal, T normal_force, T friction, const Vec3<T>& motion,
                      T inverse_distance, const Vec3<T>& slip, T slipped) {
    const T rate = T(1) / slipped, along = friction * rate;
    slides[slide_along] = along * slip;
    slides[slide_normal] = normal;
    slides[slide_across] = (square_root(along * normal_force) * rate) * cross(normal, slip);
    slides[slide_bend] = (along * square_root(normal_force * inverse_distance)) * slip;
    slides[slide_lean] = (inverse_distance * dot(moved - motion, normal)) * slides[slide_across];
  }

  // Two planes, whose edge is the only direction of slip. Friction is the sum of both; r consists of their normal
  // forces.
  PD_HD void slide_along_edge(const Vec3<T>& normal, T friction) {
    const T both = dot(first_normal, normal), share = T(1) / (T(1) - both * both);
    const Vec3<T> first = share * subtract_product(first_normal, both, normal);
    const Vec3<T> second = share * subtract_product(normal, both, first_normal);
    const Vec3<T> friction_bound = multiply_add(friction, second, first_friction * first);
    const Vec3<T> slip = projector * moved;
    const T slipped = square_root(dot(slip, slip)), force = dot(friction_bound, residual);
    if (!(force > T(0))) return;  // both are smooth
    stuck = stuck || holds(slipped, force);
    if (stuck) return;
    slides[slide_along] = (T(1) / slipped) * slip;
    slides[slide_normal] = friction_bound;
  }
};

// adds(contact): of those by which `vertex` is held along one more normal.
template <class T, class Adds>
PD_HD void find_contacts(HeldVertex<T>& vertex, const Material<T>& material,
                         std::int64_t environment, const Adds& adds) {
  const Vec3<T>& x = vertex.position;
  const auto add_contact = [&](const ContactAt<T>& contact) {
    if (vertex.add_contact(contact)) adds(contact);
  };
  for (int c = 0; c < material.planes_count; ++c) {
    const T* p = material.planes.of(environment) + planes_numbers * c;
    const Vec3<T> normal = {p[0], p[1], p[2]};
    add_contact({c,
                 normal,
                 dot(normal, x) - p[planes_height],
                 p[planes_friction],
                 {T(0), T(0), T(0)},
                 T(0)});
  }
  for (int c = 0; c < material.spheres_count; ++c) {
    const T* p = material.spheres.of(environment) + spheres_numbers * c;
    const Vec3<T> offset = x - Vec3<T>{p[0], p[1], p[2]};
    const T length = square_root(dot(offset, offset));
    if (!(length > T(0))) continue;
    add_contact({material.planes_count + c,
                 (T(1) / length) * offset,
                 length - p[spheres_radius],
                 p[spheres_friction],
                 {p[spheres_motion], p[spheres_motion + 1], p[spheres_motion + 2]},
                 T(1) / length});
  }
}

// One vertex of one environment, by the user's number; `pin` is the pin that holds it, or -1.
template <class T, class P>
struct AdjointVertex {
  const AdjointSystemCall<T, P>& call;
  std::int64_t environment;
  int vertex, pin;

  PD_HD Vec3<T> read(const T* from) const {
    const T* p = from + 3 * (environment * call.plan.vertices + vertex);
    return {p[0], p[1], p[2]};
  }

  PD_HD void write(T* to, const Vec3<T>& a) const {
    T* p = to + 3 * (environment * call.plan.vertices + vertex);
    p[0] = a.x;
    p[1] = a.y;
    p[2] = a.z;
  }

  PD_HD T mass() const { return call.material.masses.of(environment)[vertex]; }

  PD_HD T spring() const {
    return pin < 0 ? T(0) : call.material.pin_stiffness.of(environment)[pin];
  }

  PD_HD T inertia(T spring) const {
    return inertia_weight(mass(), *call.material.damping.of(environment), spring,
                          T(call.time_step));
  }

  // r = m / h^2 (1 + damping h) (x' - x) - m (v / h + gravity) - force + k (x' - pin) + elasticity; contacts do not
  // enter
  PD_HD Vec3<T> residual(const Vec3<T>& after, const Vec3<T>& moved) const {
    const T h = T(call.time_step);
    const T* g = call.material.gravity.of(environment);
    Vec3<T> pull =
        mass() * multiply_add(T(1) / h, read(call.velocities), Vec3<T>{g[0], g[1], g[2]});
    if (call.forces) pull = pull + read(call.forces);
    Vec3<T> sum = multiply_add(inertia(T(0)), moved, read(call.elastic_gradient)) - pull;
    if (pin >= 0) {
      const T* p = call.material.pin_targets.of(environment) + 3 * std::int64_t(pin);
      sum = multiply_add(spring(), after - Vec3<T>{p[0], p[1], p[2]}, sum);
    }
    return sum;
  }

  // Whether no pin holds it exactly; `weight`: its inertia with its spring.
  PD_HD static bool moves(T weight) { return weight < T(HUGE_VAL) && weight > -T(HUGE_VAL); }

  PD_HD T diagonal(T weight) const {
    return moves(weight) ? weight + call.elastic.of(environment)[vertex] : T(1);
  }

  // dL/dx' + dL/dv' / h
  PD_HD Vec3<T> loss_gradient() const {
    return multiply_add(T(1) / T(call.time_step), read(call.grad_velocities),
                        read(call.grad_positions));
  }

  // Finds the contacts that hold it; see find_contacts.
  template <class Adds>
  PD_HD HeldVertex<T> hold(T weight, const Adds& adds) const {
    const Vec3<T> after = read(call.after);
    HeldVertex<T> held{after, after - read(call.positions), {T(0), T(0), T(0)}, diagonal(weight)};
    if (moves(weight)) {
      held.residual = residual(after, held.moved);
      find_contacts(held, call.material, environment, adds);
    }
    return held;
  }

  // Writes the vertex's row of the system. A vertex held exactly, by a pin or by friction, gets zero right side and 1
  // / D.
  PD_HD void write_system() const {
    const T weight = inertia(spring()), all = diagonal(weight);
    const bool free = moves(weight);
    Vec3<T> right = free ? loss_gradient() : Vec3<T>{T(0), T(0), T(0)};
    T kept = free ? weight : T(0), inverse = free ? T(1) / all : T(0);
    if (call.projector) {
      const HeldVertex<T> held = hold(weight, [](const ContactAt<T>&) {});
      const std::int64_t at = environment * call.plan.vertices + vertex;
      for (int row = 0; row < 3; ++row) {
        T* to = call.projector + 9 * at + 3 * row;
        const Vec3<T> left = (held.stuck ? held.carried : T(1)) * held.projector.row[row];
        to[0] = left.x;
        to[1] = left.y;
        to[2] = left.z;
      }
      call.stuck[at] = held.stuck;
      for (int n = 0; n < slide_count; ++n) {
        T* to = call.sliding + 3 * (slide_count * at + n);
        const Vec3<T> slides = held.stuck ? Vec3<T>{T(0), T(0), T(0)} : held.slides[n];
        to[0] = slides.x;
        to[1] = slides.y;
        to[2] = slides.z;
      }
      kept = kept - held.curvature;
      // with the rotation of the slip, which H has
      const Vec3<T>& across = held.slides[slide_across];
      if (free) inverse = T(1) / (all + dot(across, across));
      if (held.stuck) inverse = T(0);
      right = held.projector * right;
    }
    // also where an infinite stiffness leaves no 1 / D
    if (!(inverse != T(0))) right = {T(0), T(0), T(0)};
    write(call.right, right);
    // rows that environments share are written once
    if (environment == 0 || call.rows > 1) {
      const std::int64_t at = environment * call.plan.vertices + vertex;
      call.inertia[at] = kept;
      call.inverse[at] = inverse;
    }
  }
};

// -l . dr / d(x, v) at a vertex: dL/dx = m / h^2 (1 + damping h) l - dL/dv' / h, dL/dv = m / h l. A vertex that
// friction holds moves with its start. For one that slides, l has the friction term (solver/adjoint/friction.h),
// unless that solve has failed. The result is NaN in an environment whose solve could not begin.
template <class T>
struct AdjointResult {
  const AdjointResultCall<T>& call;
  std::int64_t environment, vertex;

  PD_HD std::int64_t at() const { return environment * call.vertices + vertex; }

  PD_HD Vec3<T> read(const T* from) const {
    const T* p = from + 3 * at();
    return {p[0], p[1], p[2]};
  }

  PD_HD void write(T* to, const Vec3<T>& a) const {
    T* p = to + 3 * at();
    p[0] = a.x;
    p[1] = a.y;
    p[2] = a.z;
  }

  PD_HD void write() const {
    const T h = T(call.time_step), mass = call.masses.of(environment)[vertex];
    const double error = call.error[environment * call.error_stride];
    Vec3<T> multiplier = read(call.multiplier);
    if (!(error == error)) multiplier = {T(NAN), T(NAN), T(NAN)};
    const T inertia = inertia_weight(mass, *call.damping.of(environment), T(0), h);
    const Vec3<T> before = (T(1) / h) * read(call.grad_velocities);
    Vec3<T> sum = inertia * multiplier - before;
    if (call.stuck && call.stuck[at()]) {
      const T* p = call.projector + 9 * at();
      const Mat3<T> free = {{{p[0], p[1], p[2]}, {p[3], p[4], p[5]}, {p[6], p[7], p[8]}}};
      sum = sum + free * (read(call.grad_positions) + before - read(call.elastic));
    }
    if (call.sliding && error <= adjoint_failed * adjoint_tolerance<T>) {
      // the direction of slip rotates with its start
      const T* p = call.sliding + 3 * (slide_count * at() + slide_across);
      const Vec3<T> across = {p[0], p[1], p[2]};
      sum = multiply_add(dot(across, multiplier), across, sum);
    }
    write(call.out_positions, sum);
    write(call.out_velocities, (mass / h) * multiplier);
    write(call.out_multiplier, multiplier);
  }
};

}  // namespace pd::inline PD_TARGET
