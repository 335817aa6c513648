// Motions of components in contact, and the shares of them that all pairs allow.
//
// An island, the bodies that pairs join, goes by one common share of its motions, else it would lose momentum. A share
// turns each body about its axis by less, so no distance within a body changes: pairs of a body with itself bound
// nothing. Pairs of different bodies bound the share. One direction each keeps their sides apart at both ends, and so on
// the straight way. Pairs that are not listed are safe while vertices stay in their balls. A longer way finds the pairs
// of its swept boxes itself, joins the islands that may meet there, and a search must follow.
#pragma once
#include "solver/coarse/newton.h"
#include "solver/contact/approach.h"
#include "solver/contact/rigid.h"

namespace pd::inline PD_TARGET {

// Of the chord of a turn up to a right angle: how far a share of it leaves the straight way.
constexpr double turn_bow = 0.25;
constexpr int coarse_halvings = 6;  // of the interval of a share

template <class T, bool HasRigid>
class ContactShares {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit ContactShares(const Env& env)
      : env_(env), plan_(env.plan), a_(env.a), body_(env.body), search_(env), rigid_(env) {}

  // The shares that other bodies leave to islands, round after round until all pairs allow them.
  template <class Team>
  PD_HD void find_shares(const Team& team) const {
    ContactNumbers& numbers = env_.numbers();
    const int count = env_.components(), pairs = numbers.pairs;
    team.spread(1, [&](int) { numbers.leaves = numbers.cuts = numbers.pushes = 0; });
    team.each(count, [&](int g) {
      a_.coarse_share[g] = 1, a_.coarse_group[g] = a_.root[g];
      a_.motion[g] = part_of(g, 1);
    });
    team.each(plan_.vertices, [&](int v) {
      a_.end[v] = a_.place[v];
      if (!moves(v)) return;
      a_.end[v] = place_after(v, a_.motion[a_.component[v]]);
      Vec3<T> inside = a_.end[v];
      if (move_into(a_.ball[v], inside)) numbers.leaves = 1;
    });
    const bool leaves = numbers.leaves != 0;
    const auto swept = [&](int v) {
      Box<T> box{a_.place[v], a_.place[v]};
      box.add(a_.end[v]);
      return box;
    };
    const auto reach = [&](int v) {
      const T own = T(0.5) * plan_.thickness;
      if (!moves(v)) return own;
      const RigidMotion<double>& motion = a_.coarse_body[a_.component[v]].motion();
      const Vec3<double> chord = motion.turn * (wide(a_.place[v]) - motion.center);
      return T(turn_bow * square_root(dot(chord, chord))) + own;
    };
    bool meets = false;
    if (leaves) {
      team.each(plan_.bodies, [&](int b) { a_.itself[b] = 0; });
      team.each(plan_.body_vertices, [&](int v) {
        const int b = plan_.body[v];
        if (plan_.touches_itself[b] && a_.component[v] != a_.component[plan_.body_start[b]])
          a_.itself[b] = 1;
      });
      meets = search_.fit(team, swept, reach, true);
    }
    for (int round = 0; round < share_rounds; ++round) {
      set_limits(team);
      const auto bound = [&](const ContactPair<T>& pair) {
        lower_share(pair, round + 1 == share_rounds);
      };
      if (meets) {
        search_.each_boxed(team, [&](const auto& found) {
          found.each([&](int owner, int other) {
            ContactPair<T> pair;
            if (search_.find_pair(owner, other, pair)) bound(pair);
          });
        });
      } else if (!leaves) {
        team.each(pairs, [&](int p) { bound(a_.pair[p]); });
      }
      const bool changed = numbers.changed != 0;
      team.barrier();
      if (!changed) break;
    }
    set_limits(team);
    team.each(count, [&](int g) {
      a_.coarse_share[g] = a_.coarse_limit[g];
      a_.motion[g] = part_of(g, a_.coarse_limit[g]);
      if (a_.size[g] > 0 && is_valid(g) && a_.coarse_limit[g] < 1) numbers.cuts = 1;
    });
  }

 protected:
  PD_HD static Vec3<double> wide(const Vec3<T>& a) { return widened<double>(a); }
  PD_HD static Vec3<T> narrow(const Vec3<double>& a) { return {T(a.x), T(a.y), T(a.z)}; }

  // -1: none, or pins leave it no rigid motion
  PD_HD int component_at(int v) const {
    const int g = a_.component[v];
    return g >= 0 && a_.goes[g] ? g : -1;
  }
  PD_HD bool is_valid(int root) const { return a_.valid[root] != 0; }
  // with an island, if pins do not hold it
  PD_HD bool moves(int v) const {
    const int g = component_at(v);
    return g >= 0 && is_valid(a_.root[g]) && !env_.held(v);
  }

  PD_HD CoarseVertex<double> coarse_vertex(int i) const {
    return {wide(BodyState<T>::read(body_.x, i)), wide(BodyState<T>::read(body_.u, i)),
            double(body_.inverse_of(i))};
  }
  PD_HD Vec3<double> position(int i) const {
    const CoarseVertex<double> v = coarse_vertex(i);
    return v.x + v.u;
  }

  // A share of the motion of a component.
  PD_HD RigidMotion<double> part_of(int g, double share) const {
    RigidMotion<double> motion = a_.coarse_body[g].motion();
    if (share < 1) {
      motion.turn = small_turn(share * turn_vector(motion));
      motion.shift = share * motion.shift;
    }
    return motion;
  }

  PD_HD Pose<T> pose_after(int c, const RigidMotion<double>& motion) const {
    return moved(a_.hand[c].pose, a_.rigid_collider[c].center, motion.shift, turn_vector(motion));
  }

  PD_HD Vec3<T> place_after(int v, const RigidMotion<double>& motion) const {
    if (rigid_.exist() && v >= plan_.body_vertices)
      return pose_after(plan_.collider[v], motion).place(local_point(plan_, v));
    const int i = a_.inside[v];
    const Vec3<T> u = BodyState<T>::read(body_.u, i) + narrow(motion.of(position(i)));
    return body_.place(i, u);
  }

  const Env& env_;
  const ContactPlan<T>& plan_;
  const ContactArrays<T>& a_;
  const BodyState<T>& body_;
  const ContactSearch<T> search_;
  const RigidColliders<T, HasRigid> rigid_;

 private:
  // One share for the islands of a group.
  template <class Team>
  PD_HD void set_limits(const Team& team) const {
    const int count = env_.components();
    team.spread(1, [&](int) { env_.numbers().changed = 0; });
    team.each(count, [&](int g) { a_.coarse_joint[g] = 1; });
    team.each(count, [&](int g) {
      if (a_.local[g] >= 0)
        lower(a_.coarse_joint + root_of(a_.coarse_group, g), a_.coarse_share[a_.root[g]]);
    });
    team.each(count,
              [&](int g) { a_.coarse_limit[g] = a_.coarse_joint[root_of(a_.coarse_group, g)]; });
  }

  // Lowers the shares of both sides to what keeps a pair of different components apart; in the `last` round to 0.
  PD_HD void lower_share(const ContactPair<T>& pair, bool last) const {
    const int side[2] = {component_at(pair.vertex[0]), component_at(pair.vertex[3])};
    if (side[0] == side[1]) return;
    bool some = false;
    for (int v : pair.vertex) some = some || moves(v);
    if (!some) return;
    const auto goes = [&](int g) { return g >= 0 && is_valid(a_.root[g]); };
    double limit = 1;
    for (int g : side)
      if (goes(g) && a_.coarse_limit[g] < limit) limit = a_.coarse_limit[g];
    if (goes(side[0]) && goes(side[1])) join(a_.coarse_group, a_.root[side[0]], a_.root[side[1]]);
    Vec3<T> start[4], end[4];
    pair.corners(a_.place, start);
    pair.corners(a_.end, end);
    const Kept<T> kept = direction_of(pair, start, end);
    const auto allowed = [&](double share) {
      if (share < 1) {
        for (int c = 0; c < 4; ++c) {
          const int v = pair.vertex[c];
          if (moves(v)) end[c] = place_after(v, part_of(a_.component[v], share));
        }
      }
      return kept.allows(pair.edges, end);
    };
    if (allowed(limit)) return;
    double least = 0, most = 1;
    for (int n = 0; n < coarse_halvings; ++n) {
      const double middle = 0.5 * (least + most);
      (middle < limit && allowed(middle) ? least : most) = middle;
    }
    env_.numbers().changed = 1;
    for (int g : side)
      if (goes(g)) lower(a_.coarse_share + a_.root[g], last ? 0.0 : least);
  }
};

}  // namespace pd::inline PD_TARGET
