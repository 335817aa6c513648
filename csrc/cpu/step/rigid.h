// The coarse correction of solver/coarse: rigid motions of bodies, by one thread.
#pragma once
#include "cpu/step/workspace.h"

#include <vector>

namespace pd::inline PD_TARGET {

template <class Lanes, class Visit>
void each_in_a_body(const Plan<typename Lanes::Scalar>& plan, const Visit& visit) {
  for (int i = 0; i < plan.vertices; ++i) {
    if (plan.vertex_component[i] >= 0) visit(i, plan.vertex_component[i]);
  }
}

// Of one environment.
template <int Count, class Lanes>
void read_lane(const typename Lanes::Wide (&sum)[Count], int lane, double (&one)[Count]) {
  for (int n = 0; n < Count; ++n) one[n] = Lanes::lane(sum[n], lane);
}

// Sets a number, vector or matrix of one environment.
template <class Lanes, class Number>
void put_lane(Number& to, int lane, double from) {
  if constexpr (Lanes::environments == 1) {
    to = Number(from);
  } else {
    to.v[lane] = from;
  }
}
template <class Lanes, class Number>
void put_lane(Vec3<Number>& to, int lane, const Vec3<double>& from) {
  put_lane<Lanes>(to.x, lane, from.x);
  put_lane<Lanes>(to.y, lane, from.y);
  put_lane<Lanes>(to.z, lane, from.z);
}
template <class Lanes, class Number>
void put_lane(Mat3<Number>& to, int lane, const Mat3<double>& from) {
  for (int r = 0; r < 3; ++r) put_lane<Lanes>(to.row[r], lane, from.row[r]);
}

// The forces of the contacts of one vertex, in double.
template <class Lanes>
struct VertexForces {
  using Wide = typename Lanes::Wide;
  const Workspace<Lanes>& w;
  int vertices, i;

  Vec3<Wide> force(int n) const {
    return widened<Wide>(Lanes::vec3(w.contact_force[std::int64_t(n) * vertices + i]));
  }
  Wide radius(int n) const {
    return Lanes::widen(w.friction_radius[std::int64_t(n) * vertices + i]);
  }
  void set_radius(int n, const Wide& radius) const {
    w.friction_radius[std::int64_t(n) * vertices + i] = Lanes::narrow(radius);
  }
  void set(int n, const Vec3<Wide>& force, const Wide& radius) const {
    w.contact_force[std::int64_t(n) * vertices + i] =
        Lanes::value({Lanes::narrow(force.x), Lanes::narrow(force.y), Lanes::narrow(force.z)});
    set_radius(n, radius);
  }
};

template <class Lanes>
CoarseVertex<typename Lanes::Wide> coarse_vertex(const Workspace<Lanes>& w, std::int64_t i) {
  return {widened<typename Lanes::Wide>(Lanes::vec3(w.x[i])),
          widened<typename Lanes::Wide>(Lanes::vec3(w.u[i])), Lanes::widen(w.inverse[i])};
}

template <class Lanes>
void sum_bodies(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w) {
  using Wide = typename Lanes::Wide;
  using S = RigidSums;
  const auto at = [&](int i) {
    return widened<Wide>(Lanes::vec3(w.x[i])) + widened<Wide>(Lanes::vec3(w.u[i]));
  };
  for (int g = 0; g < plan.components; ++g) {
    for (Wide& sum : w.body_sums[g].rigid) sum = Wide(0.0);
  }
  each_in_a_body<Lanes>(plan, [&](int i, int g) {
    add_mean(w.body_sums[g].rigid + S::weight, Lanes::widen(w.inertia[i]), at(i));
  });
  for (int g = 0; g < plan.components; ++g) {
    BodySums<Wide>& sums = w.body_sums[g];
    const Wide weight = sums.rigid[S::weight], none(0.0), one(1.0);
    const Wide share = one / select(weight > none, weight, one);
    const Wide* sum = sums.rigid + S::position;
    sums.center = {share * sum[0], share * sum[1], share * sum[2]};
  }
  each_in_a_body<Lanes>(plan, [&](int i, int g) {
    BodySums<Wide>& sums = w.body_sums[g];
    const Wide a = Lanes::widen(w.inertia[i]);
    add_moments(sums.rigid + S::target_offset, a, at(i) - sums.center,
                widened<Wide>(Lanes::vec3(w.target[i] - w.u[i])));
    if (plan.pins > 0) add_pin(sums.rigid + S::pins, a, at(i));
  });
}

// Trials of the next pass of body g; whether it has one in some environment.
template <class Lanes>
bool set_trial(Workspace<Lanes>& w, int g) {
  bool goes_on = false;
  for (int lane = 0; lane < Lanes::environments; ++lane) {
    const CoarseBody& body = w.bodies[g * Lanes::environments + lane];
    goes_on = goes_on || !body.is_done();
    const CoarseTrial<double> from = body.trial();
    CoarseTrial<typename Lanes::Wide>& to = w.trial[g];
    put_lane<Lanes>(to.turn_before, lane, from.turn_before);
    put_lane<Lanes>(to.turn_after, lane, from.turn_after);
    put_lane<Lanes>(to.center, lane, from.center);
    put_lane<Lanes>(to.shift_before, lane, from.shift_before);
    put_lane<Lanes>(to.shift_after, lane, from.shift_after);
    put_lane<Lanes>(to.renews, lane, body.is_done() ? 0.0 : from.renews);
  }
  return goes_on;
}

// Motions of all bodies.
template <bool HasContacts, class Lanes>
void find_motions(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                  const Contacts<typename Lanes::Real>& contacts) {
  using Wide = typename Lanes::Wide;
  constexpr int lanes = Lanes::environments;
  sum_bodies(plan, w);
  for (int n = 0; n < plan.components * lanes; ++n) {
    double sum[RigidSums::count];
    read_lane<RigidSums::count, Lanes>(w.body_sums[n / lanes].rigid, n % lanes, sum);
    w.bodies[n] = CoarseBody(RigidBody(sum));
    put_lane<Lanes>(w.body_sums[n / lanes].moves, n % lanes, w.bodies[n].moves() ? 1.0 : 0.0);
    const double none[ContactSums::count] = {};
    while (!HasContacts && !w.bodies[n].is_done()) w.bodies[n].pass(none);
  }
  bool some = HasContacts;
  while (some) {
    some = false;
    for (int g = 0; g < plan.components; ++g) {
      w.body_sums[g].goes_on = set_trial(w, g);
      some = some || w.body_sums[g].goes_on;
      for (Wide& sum : w.body_sums[g].contact) sum = Wide(0.0);
    }
    if (!some) break;
    each_in_a_body<Lanes>(plan, [&](int i, int g) {
      if (!w.body_sums[g].goes_on) return;
      each_contact_term(contacts, coarse_vertex(w, i), w.trial[g],
                        VertexForces<Lanes>{w, plan.vertices, i},
                        [&](bool adds, const auto& terms) {
                          if (adds) add_terms(w.body_sums[g].contact, terms());
                        });
    });
    for (int n = 0; n < plan.components * lanes; ++n) {
      if (w.bodies[n].is_done()) continue;
      double sum[ContactSums::count];
      read_lane<ContactSums::count, Lanes>(w.body_sums[n / lanes].contact, n % lanes, sum);
      w.bodies[n].pass(sum);
    }
  }
  for (int n = 0; n < plan.components * lanes; ++n) {
    RigidMotion<Wide>& to = w.motion[n / lanes];
    const RigidMotion<double>& from = w.bodies[n].motion();
    put_lane<Lanes>(to.turn, n % lanes, from.turn);
    put_lane<Lanes>(to.center, n % lanes, from.center);
    put_lane<Lanes>(to.shift, n % lanes, from.shift);
  }
}

}  // namespace pd::inline PD_TARGET
