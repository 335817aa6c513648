// The rigid motions of solver/rigid/free_motion.h, by one thread.
#pragma once
#include "cpu/step/workspace.h"

namespace pd::inline PD_TARGET {

template <class Lanes, class Visit>
void each_in_a_piece(const Plan<typename Lanes::Scalar>& plan, const Visit& visit) {
  for (int i = 0; i < plan.vertices; ++i) {
    if (plan.vertex_component[i] >= 0) visit(i, plan.vertex_component[i]);
  }
}

// Of one environment.
template <int Count, class Lanes>
void read_lane(const typename Lanes::Wide (&sum)[Count], int lane, double (&one)[Count]) {
  for (int n = 0; n < Count; ++n) one[n] = Lanes::lane(sum[n], lane);
}

// Sets pieces to where they are that start from there. `vertex(i)`, `guess(i)`: what Stepper has of one.
template <class Lanes, class VertexOf, class Guess>
void begin_still(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                 const Contacts<typename Lanes::Real>& contacts, const VertexOf& vertex,
                 const Guess& guess) {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  for (int g = 0; g < plan.components; ++g) {
    for (Wide& sum : w.component_sums[g].start) sum = Wide(0.0);
  }
  const Real none(T(0));
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    const auto v = vertex(i);
    const auto vec3 = [](const auto& a) { return Lanes::vec3(a); };
    add_start(w.component_sums[g].start, contacts, vec3(v.x), vec3(v.target), v.inertia, v.inverse,
              vec3(w.u[i]), vec3(v.current_iterate(contacts)), vec3(w.u[i] - guess(i)));
  });
  bool some = false;
  for (int g = 0; g < plan.components; ++g) {
    ComponentSums<Wide>& sums = w.component_sums[g];
    sums.still = false;
    for (int lane = 0; lane < Lanes::environments; ++lane) {
      double sum[StartSums::count];
      read_lane<StartSums::count, Lanes>(sums.start, lane, sum);
      const bool still = starts_still(sum);
      Lanes::set_lane(w.still[g], lane, T(still));
      sums.still = sums.still || still;
    }
    some = some || sums.still;
  }
  if (!some) return;
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    if (!w.component_sums[g].still) return;
    const auto stays = w.still[g] > none;
    const Vec3<Real> u = Lanes::vec3(w.u[i]),
                     still = Lanes::vec3(vertex(i).current_iterate(contacts));
    w.u[i] = Lanes::value(
        {select(stays, still.x, u.x), select(stays, still.y, u.y), select(stays, still.z, u.z)});
  });
}

template <class Lanes>
void sum_pieces(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w) {
  using Wide = typename Lanes::Wide;
  using S = RigidSums;
  const auto widen = [](const Vec3<typename Lanes::Real>& a) {
    return Vec3<Wide>{Lanes::widen(a.x), Lanes::widen(a.y), Lanes::widen(a.z)};
  };
  const auto at = [&](int i) { return widen(Lanes::vec3(w.x[i])) + widen(Lanes::vec3(w.u[i])); };
  for (int g = 0; g < plan.components; ++g) w.component_sums[g] = {};
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    add_mean(w.component_sums[g].rigid + S::weight, Lanes::widen(w.inertia[i]), at(i));
  });
  for (int g = 0; g < plan.components; ++g) {
    ComponentSums<Wide>& sums = w.component_sums[g];
    const Wide weight = sums.rigid[S::weight], none(0.0), one(1.0);
    const Wide share = one / select(weight > none, weight, one);
    const Wide* sum = sums.rigid + S::position;
    sums.center = {share * sum[0], share * sum[1], share * sum[2]};
  }
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    ComponentSums<Wide>& sums = w.component_sums[g];
    const Wide a = Lanes::widen(w.inertia[i]);
    const Vec3<Wide> lever_arm = at(i) - sums.center;
    add_moments(sums.rigid + S::target_offset, a, lever_arm,
                widen(Lanes::vec3(w.target[i] - w.u[i])));
    if (plan.pins > 0) add_pin(sums.rigid + S::pins, a, lever_arm);
  });
}

template <class Lanes>
void set_motion(Workspace<Lanes>& w, int g, int lane, const RigidMotion<double>& motion) {
  using T = typename Lanes::Scalar;
  RigidMotion<typename Lanes::Real>& to = w.motion[g];
  const auto set = [&](Vec3<typename Lanes::Real>& v, const Vec3<double>& a) {
    Lanes::set_lane(v.x, lane, T(a.x));
    Lanes::set_lane(v.y, lane, T(a.y));
    Lanes::set_lane(v.z, lane, T(a.z));
  };
  for (int r = 0; r < 3; ++r) set(to.turn.row[r], motion.turn.row[r]);
  set(to.center, motion.center);
  set(to.shift, motion.shift);
}

template <class Lanes>
RigidFit fit_of(const Workspace<Lanes>& w, int g, int lane) {
  double sum[RigidSums::count];
  read_lane<RigidSums::count, Lanes>(w.component_sums[g].rigid, lane, sum);
  return RigidFit(sum);
}

// Of pieces that go on, or in the first leg all.
template <class Lanes>
void free_motions(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w, int leg) {
  for (int g = 0; g < plan.components; ++g) {
    for (int lane = 0; lane < Lanes::environments; ++lane) {
      bool& goes_on = w.goes_on[g * Lanes::environments + lane];
      goes_on = goes_on || leg == 0;
      const RigidFit fit = fit_of(w, g, lane);
      set_motion(w, g, lane, goes_on ? fit.free() : fit.still());
    }
  }
}

// One of the first planes, of one environment.
template <class Lanes>
Plane<double> plane_of(const Contacts<typename Lanes::Real>& contacts, int k, int lane) {
  const auto& p = contacts.planes[k];
  const auto number = [&](const auto& a) { return Lanes::lane(Lanes::widen(a), lane); };
  return {{number(p.normal.x), number(p.normal.y), number(p.normal.z)},
          number(p.height),
          number(p.friction)};
}

template <class Lanes>
void find_touched(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                  const Contacts<typename Lanes::Real>& contacts, bool first) {
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  for (int g = 0; g < plan.components; ++g) {
    ComponentSums<Wide>& sums = w.component_sums[g];
    for (Wide& least : sums.gaps) least = Wide(HUGE_VAL);
    for (Wide& sum : sums.touch) sum = Wide(0.0);
    for (Wide& least : sums.bounds) least = Wide(HUGE_VAL);
  }
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    ComponentSums<Wide>& sums = w.component_sums[g];
    const auto near = [&](int k, const Real& gap) {
      sums.gaps[k] = lesser(sums.gaps[k], Lanes::widen(gap));
    };
    const Vec3<Real> u = Lanes::vec3(w.u[i]);
    add_touch(sums.touch, sums.bounds, contacts, Lanes::vec3(w.x[i] + w.u[i]), u, w.motion[g],
              !first, near);
  });
}

// A bit for each contact that a piece would touch if it moved freely, see Touch.
template <class Lanes>
unsigned touched_by(const Workspace<Lanes>& w, int g, int lane) {
  unsigned touched = 0;
  for (int k = 0; k <= Touch::planes; ++k) {
    if (!(Lanes::lane(w.component_sums[g].gaps[k], lane) > 0)) touched |= 1u << k;
  }
  return touched;
}

// What is left to a piece that does not tip.
template <class Lanes>
void set_motion_on_contacts(Workspace<Lanes>& w, const Contacts<typename Lanes::Real>& contacts,
                            int g, int lane) {
  const auto& sums = w.component_sums[g];
  double touch[Touch::sums], bounds[Touch::bounds];
  read_lane<Touch::sums, Lanes>(sums.touch, lane, touch);
  read_lane<Touch::bounds, Lanes>(sums.bounds, lane, bounds);
  const auto plane = [&](int k) { return plane_of<Lanes>(contacts, k, lane); };
  const unsigned touched = touched_by(w, g, lane);
  w.goes_on[g * Lanes::environments + lane] = comes_to_plane(touched, bounds);
  set_motion(w, g, lane, motion_on_contacts(fit_of(w, g, lane), touched, touch, bounds, plane));
}

template <class Lanes>
void set_search(Workspace<Lanes>& w, const Contacts<typename Lanes::Real>& contacts, int g,
                int lane) {
  using T = typename Lanes::Scalar;
  const Tipping& tipping = w.tipping[g * Lanes::environments + lane];
  if (!tipping.goes_on()) return;
  const TippingSearch<double> one = tipping.search(plane_of<Lanes>(contacts, tipping.number, lane));
  TippingSearch<typename Lanes::Real>& to = w.search[g];
  const auto set = [&](Vec3<typename Lanes::Real>& v, const Vec3<double>& a) {
    Lanes::set_lane(v.x, lane, T(a.x));
    Lanes::set_lane(v.y, lane, T(a.y));
    Lanes::set_lane(v.z, lane, T(a.z));
  };
  set(to.normal, one.normal);
  set(to.away, one.away);
  Lanes::set_lane(to.height, lane, T(one.height));
  Lanes::set_lane(to.reach, lane, T(one.reach));
  Lanes::set_lane(to.seeks, lane, T(one.seeks));
  Lanes::set_lane(to.down, lane, T(one.down));
}

// Motions of pieces that tip: solver/rigid/rolling_contact.h. Returns whether there are any.
template <class Lanes>
bool tip_motions(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                 const Contacts<typename Lanes::Real>& contacts) {
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  constexpr int lanes = Lanes::environments;
  bool some = false;
  for (int g = 0; g < plan.components; ++g) {
    bool& tips = w.component_sums[g].tips;
    tips = false;
    for (int lane = 0; lane < lanes; ++lane) tips = tips || w.tipping[g * lanes + lane].goes_on();
    some = some || tips;
  }
  if (!some) return false;
  const auto widen = [](const Vec3<Real>& a) {
    return Vec3<Wide>{Lanes::widen(a.x), Lanes::widen(a.y), Lanes::widen(a.z)};
  };
  for (int g = 0; g < plan.components; ++g) {
    for (Wide& number : w.component_sums[g].found) number = Wide(HUGE_VAL);
  }
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    if (!w.component_sums[g].tips) return;
    const Vec3<Real> u = Lanes::vec3(w.u[i]), y = Lanes::vec3(w.x[i] + w.u[i]);
    Real order, depth, left;
    w.search[g].look(contacts, w.motion[g], y, order, depth, left);
    keep_found(w.component_sums[g].found, Lanes::widen(order), Lanes::widen(depth),
               Lanes::widen(left), widen(y), widen(u));
  });
  for (int g = 0; g < plan.components; ++g) {
    for (int lane = 0; lane < lanes; ++lane) {
      Tipping& tipping = w.tipping[g * lanes + lane];
      if (!tipping.goes_on()) continue;
      double found[Found::count];
      read_lane<Found::count, Lanes>(w.component_sums[g].found, lane, found);
      RigidMotion<double> motion;
      if (tipping.next(fit_of(w, g, lane), plane_of<Lanes>(contacts, tipping.number, lane), found,
                       motion)) {
        set_motion(w, g, lane, motion);
        set_search(w, contacts, g, lane);
        w.goes_on[g * lanes + lane] = tipping.comes();
      } else {
        set_motion_on_contacts(w, contacts, g, lane);
      }
    }
  }
  return true;
}

template <class Lanes>
void limit_motions(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                   const Contacts<typename Lanes::Real>& contacts, bool first) {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Wide = typename Lanes::Wide;
  constexpr int lanes = Lanes::environments;
  find_touched(plan, w, contacts, first);
  for (int g = 0; g < plan.components; ++g) {
    for (int lane = 0; lane < lanes; ++lane) {
      const bool goes_on = w.goes_on[g * lanes + lane];
      const unsigned touched = goes_on ? touched_by(w, g, lane) : 0;
      for (int k = 0; k < Touch::planes; ++k)
        Lanes::set_lane(w.touched[g][k], lane, T(touched >> k & 1));
      bool tips = false;
      if (contacts.plane_count > 0) {
        double touch[Touch::sums];
        read_lane<Touch::sums, Lanes>(w.component_sums[g].touch, lane, touch);
        Tipping& tipping = w.tipping[g * lanes + lane];
        begin_tipping(tipping, first, fit_of(w, g, lane), touched, touch,
                      [&](int k) { return plane_of<Lanes>(contacts, k, lane); });
        set_search(w, contacts, g, lane);
        tips = tipping.goes_on();
      }
      if (goes_on && !tips) set_motion_on_contacts(w, contacts, g, lane);
    }
  }
  while (contacts.plane_count > 0 && tip_motions(plan, w, contacts)) {
  }
  if (!contacts.has_multiple()) return;
  // what is left must not lead into other contacts
  for (int g = 0; g < plan.components; ++g) w.component_sums[g].gaps[0] = Wide(HUGE_VAL);
  each_in_a_piece<Lanes>(plan, [&](int i, int g) {
    const auto touches = [&](int k) { return w.touched[g][k] > Real(T(0)); };
    const Vec3<Real> y = Lanes::vec3(w.x[i] + w.u[i]);
    const Real least = least_gap_beside(contacts, y, w.motion[g].of(y), !first, touches);
    w.component_sums[g].gaps[0] = lesser(w.component_sums[g].gaps[0], Lanes::widen(least));
  });
  for (int g = 0; g < plan.components; ++g) {
    for (int lane = 0; lane < lanes; ++lane) {
      const bool tips = contacts.plane_count > 0 && w.tipping[g * lanes + lane].tips;
      if (tips || Lanes::lane(w.component_sums[g].gaps[0], lane) > 0) continue;
      set_motion(w, g, lane, fit_of(w, g, lane).still());
      w.goes_on[g * lanes + lane] = false;
    }
  }
}

// Motions of all pieces, in one leg; whether some go on in another.
template <bool HasContacts, class Lanes>
bool find_motions(const Plan<typename Lanes::Scalar>& plan, Workspace<Lanes>& w,
                  const Contacts<typename Lanes::Real>& contacts, bool first, int leg) {
  sum_pieces(plan, w);
  free_motions(plan, w, leg);
  bool some = false;
  if constexpr (HasContacts) {
    limit_motions(plan, w, contacts, first);
    for (int n = 0; n < plan.components * Lanes::environments; ++n) some = some || w.goes_on[n];
  }
  return some && leg + 1 < motion_legs;
}

}  // namespace pd::inline PD_TARGET
