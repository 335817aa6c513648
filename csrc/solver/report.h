// The report of a solved step: its energy, the number of inverted elements, and the residual
//
//   (|r| - rounding)+ / max(|f|, |r|),   |f|^2 = sum_i |a_i (u_i - s_i)|^2 + |f_i|^2,
//
// where r [N] is the part of grad E that neither pins nor contacts balance. f_i is the elastic force on vertex i, and
// a (u - s) the force of inertia, springs, gravity and external forces. The two cancel where a step is solved;
// rounding is what then remains of r. It is a few roundings of every product of stiffness and position:
//
//   rounding = 4 eps sqrt(sum_i (sum_e w V |grad N_i|^2 |x| + a_i |u_i| + [contact force] D_i |n| . |x_i + u_i|)^2).
//
// Without this term a body light compared with E x, such as a stiff one under its weight, or a force-free drift,
// would read as unsolved. Solved steps have shown up to half of the factor four.
#pragma once
#include "math/vec.h"
#include "solver/vertex.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

constexpr double report_roundings = 4;

// The contacts of an environment, read from its material one after another: `Contacts` for a single visit of a
// vertex.
template <class T>
struct MaterialContacts {
  const Material<T>& material;
  std::int64_t environment;

  PD_HD Vec3<T> project(const Vec3<T>& x, Vec3<T> u, const Vec3<T>& around) const {
    for (int c = 0; c < material.planes_count; ++c) {
      const T* p = material.planes.of(environment) + planes_numbers * c;
      const Plane<T> plane = {{p[0], p[1], p[2]}, p[planes_height], p[planes_friction]};
      u = pd::project(plane, x, u, around);
    }
    for (int c = 0; c < material.spheres_count; ++c) {
      const T* p = material.spheres.of(environment) + spheres_numbers * c;
      const T* motion = p + spheres_motion;
      const Sphere<T> sphere = {{p[0], p[1], p[2]},
                                {motion[0], motion[1], motion[2]},
                                p[spheres_radius],
                                p[spheres_friction]};
      u = pd::project(sphere, x, u, around);
    }
    return u;
  }

  // The largest number that enters a gap at this position: its rounding changes the contact force.
  PD_HD double size(const Vec3<T>& place) const {
    double most = 0;
    for (int c = 0; c < material.planes_count; ++c) {
      const T* p = material.planes.of(environment) + planes_numbers * c;
      const double along = absolute(double(p[0]) * double(place.x)) +
                           absolute(double(p[1]) * double(place.y)) +
                           absolute(double(p[2]) * double(place.z));
      most = along > most ? along : most;
    }
    const double whole = sqrt(double(dot(place, place)));
    return material.spheres_count > 0 && whole > most ? whole : most;
  }
};

// One vertex of one environment, by the user's number; `pin` is the pin that holds it, or -1.
template <class T, class P>
struct ReportVertex {
  const ReportCall<T, P>& call;
  std::int64_t environment;
  int vertex, pin;

  PD_HD Vec3<T> read(const T* from) const {
    const T* p = from + 3 * (environment * call.plan.vertices + vertex);
    return {p[0], p[1], p[2]};
  }

  PD_HD T mass() const { return call.material.masses.of(environment)[vertex]; }
  PD_HD T spring() const {
    return pin < 0 ? T(0) : call.material.pin_stiffness.of(environment)[pin];
  }
  PD_HD T weight(T stiffness) const {
    return inertia_weight(mass(), *call.material.damping.of(environment), stiffness,
                          T(call.time_step));
  }

  // the target s, as a step computes it
  PD_HD Vec3<T> target(const Vec3<T>& x, T stiffness) const {
    Vec3<T> offset = {T(0), T(0), T(0)}, force = offset;
    if (pin >= 0) {
      const T* p = call.material.pin_targets.of(environment) + 3 * std::int64_t(pin);
      offset = Vec3<T>{p[0], p[1], p[2]} - x;
    }
    if (!(stiffness < T(HUGE_VAL))) return offset;
    if (call.forces) force = read(call.forces);
    const T* g = call.material.gravity.of(environment);
    return inertia_target(weight(stiffness), mass(), read(call.velocities),
                          Vec3<T>{g[0], g[1], g[2]}, force, stiffness, offset, T(call.time_step));
  }

  PD_HD static double square(const Vec3<T>& a) {
    const double x = double(a.x), y = double(a.y), z = double(a.z);
    return (x * x + y * y) + z * z;
  }

  // of pairs between bodies
  PD_HD Vec3<T> contact_force() const {
    if (!call.contact) return {T(0), T(0), T(0)};
    const T* p = call.contact + 3 * (environment * call.contact_rows + vertex);
    return {p[0], p[1], p[2]};
  }

  // Adds the vertex's terms to every ReportSum.
  PD_HD void add_to(double (&sum)[report_sums]) const {
    const T stiffness = spring(), elastic = call.elastic.of(environment)[vertex];
    const T a = held_inertia(weight(stiffness), stiffness);
    const Vec3<T> x = read(call.positions), u = read(call.displacement);
    const Vec3<T> elements = read(call.elements), force = read(call.elastic_gradient);
    const Vertex<Thread<T>, true> at = {x, target(x, stiffness), a, inverse_diagonal(a, elastic)};
    const Vec3<T> none = {T(0), T(0), T(0)}, twice = at.add_energy(u, none);
    sum[report_energy] += double(elements.x) + 0.5 * double((twice.x + twice.y) + twice.z);
    sum[report_inverted] += double(elements.z);
    sum[report_invalid] += inertia_ratio(a, elastic, at.inverse) < T(0) ? 1 : 0;
    if (!(at.inverse > T(0))) return;
    const MaterialContacts<T> contacts{call.material, environment};
    const Vec3<T> left = force - contact_force();
    const Vec3<T> slope = at.gradient(u, left), free = subtract_product(u, at.inverse, slope);
    const Vec3<T> pushed = contacts.project(x, free, u) - free;
    const bool touches = !(dot(pushed, pushed) == T(0));
    sum[report_residual] += square(touches ? at.residual(contacts, u, left) : slope);
    sum[report_force] += square(a * (u - at.target)) + square(force);
    double rounding = double(elements.y) + double(a) * sqrt(square(u));
    if (touches) rounding += contacts.size(x + u) / double(at.inverse);
    sum[report_rounding] += rounding * rounding;
  }
};

// Writes a row of the report from an environment's sums; NaN where material or state are NaN, infinite or negative.
template <class T>
PD_HD void write_report(const double (&sum)[report_sums], double* row) {
  const double rounding = report_roundings * double(epsilon<T>()) * sqrt(sum[report_rounding]);
  const double residual = sqrt(sum[report_residual]), force = sqrt(sum[report_force]);
  const double whole = residual > force ? residual : force;
  const bool known = sum[report_invalid] == 0 && absolute(sum[report_energy]) < HUGE_VAL &&
                     residual < HUGE_VAL && force < HUGE_VAL && rounding < HUGE_VAL;
  row[info_residual] = !known ? NAN : residual > rounding ? (residual - rounding) / whole : 0;
  row[info_energy] = sum[report_energy];
  row[info_inverted] = sum[report_inverted];
  if (!known) row[info_converged] = 0;
}

}  // namespace pd::inline PD_TARGET
