// User inputs of one environment, by internal vertex.
#pragma once
#include "contact/plane_sphere.h"
#include "cuda/common/memory.h"
#include "solver/chebyshev.h"
#include "solver/step.h"
#include "solver/vertex.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The state of an environment's solve: schedule, stopping rule and counters.
struct Progress {
  Schedule schedule;
  double min_share;  // smallest a / D
  StoppingTest stop;
  int used;  // iterations
  bool done;

  // Whether the tolerance is met, from the sums of an iteration with weight omega.
  PD_HD bool ends(double tolerance, double omega, double change, double displacement) {
    return stop.is_met(tolerance, schedule.error_share(omega), change, displacement);
  }
};

template <class T>
struct Inputs {
  const DeviceStep<T>* call;
  std::int64_t environment;

  PD_DEVICE std::int64_t row(int vertex) const {
    const DevicePlan<T>& plan = call->plan;
    return (environment * plan.vertices + plan.vertex_order[vertex]) * 3;
  }

  PD_DEVICE Vec3<T> at_vertex(const T* from, int vertex) const { return read3(from + row(vertex)); }

  PD_DEVICE Vec3<T> first_iterate(int vertex) const { return at_vertex(call->start, vertex); }

  PD_DEVICE T mass(int vertex) const {
    return call->material.masses.of(environment)[call->plan.vertex_order[vertex]];
  }

  PD_DEVICE int pin(int vertex) const {
    return call->plan.pins ? call->plan.vertex_pin[vertex] : -1;
  }

  PD_DEVICE T pin_stiffness(int pin) const {
    return pin < 0 ? T(0) : call->material.pin_stiffness.of(environment)[pin];
  }

  PD_DEVICE T damping() const { return *call->material.damping.of(environment); }

  // The inertial weight a; zero where a hard pin prescribes the vertex.
  PD_DEVICE T inertia(int vertex, T h) const {
    const T stiffness = pin_stiffness(pin(vertex));
    return held_inertia(inertia_weight(mass(vertex), damping(), stiffness, h), stiffness);
  }

  // The target displacement s of all forces but elasticity.
  PD_DEVICE Vec3<T> target(int vertex, const Vec3<T>& x, const Vec3<T>& velocity, T h) const {
    const int index = pin(vertex);
    const T stiffness = pin_stiffness(index);
    Vec3<T> offset = {T(0), T(0), T(0)}, force = offset;
    if (index >= 0)
      offset = read3(call->material.pin_targets.of(environment) + 3 * std::int64_t(index)) - x;
    if (!(stiffness < T(HUGE_VAL))) return offset;
    if (call->forces) force = at_vertex(call->forces, vertex);
    const T weight = inertia_weight(mass(vertex), damping(), stiffness, h);
    const Vec3<T> gravity = read3(call->material.gravity.of(environment));
    return inertia_target(weight, mass(vertex), velocity, gravity, force, stiffness, offset, h);
  }

  PD_DEVICE double free_fall_squared() const {
    const Vec3<T> gravity = read3(call->material.gravity.of(environment));
    return squared_free_fall(call->plan.vertices, call->settings.time_step, gravity);
  }

  PD_DEVICE void read_contacts(Plane<T>* planes, Sphere<T>* spheres) const {
    const Material<T>& material = call->material;
    for (int c = 0; c < material.planes_count; ++c) {
      const T* p = material.planes.of(environment) + planes_numbers * c;
      planes[c] = {read3(p), p[planes_height], p[planes_friction]};
    }
    for (int c = 0; c < material.spheres_count; ++c) {
      const T* p = material.spheres.of(environment) + spheres_numbers * c;
      spheres[c] = {read3(p), read3(p + spheres_motion), p[spheres_radius], p[spheres_friction]};
    }
  }

  PD_DEVICE void write(int record, int vertex, const Vec3<T>& x, const Vec3<T>& velocity) const {
    const std::int64_t at = record * call->batch * call->plan.vertices * 3 + row(vertex);
    write3(call->out_positions + at, x);
    write3(call->out_velocities + at, velocity);
  }

  PD_DEVICE void write_info(int record, const Progress& progress) const {
    if (!call->info) return;
    double* to = call->info + (record * call->batch + environment) * info_count;
    to[info_residual] = to[info_energy] = NAN;
    to[info_iterations] = progress.used;
    to[info_restarts] = progress.schedule.restarts;
    to[info_converged] = progress.done && progress.min_share >= 0;
    to[info_rho] = progress.schedule.rho;
    to[info_inverted] = -1;
  }
};

}  // namespace pd::inline PD_TARGET
