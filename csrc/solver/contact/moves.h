// The moves of an iterate: what wants to go where, and how far planes and balls let it.
#pragma once
#include "solver/contact/rigid.h"
#include "solver/contact/search.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasRigid>
class ContactMoves {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit ContactMoves(const Env& env)
      : env_(env), plan_(env.plan), a_(env.a), body_(env.body), search_(env), rigid_(env) {}

  // Targets of the next move: displacements of bodies, and the goals of what moves by hand.
  PD_HD void want_vertex(int i, const T* displacement) const {
    const int v = body_.order[i];
    const Vec3<T> u = BodyState<T>::read(displacement, i);
    BodyState<T>::write(body_.free, i, u);
    a_.target[v] = env_.held(v) ? a_.goal[v] : body_.place(i, u);
  }
  // `aims`: colliders with a mass to the ends of their free motions
  template <class Team>
  PD_HD void want(const Team& team, const T* displacement, bool aims) const {
    team.spread(1, [&](int) { env_.numbers().cut = 0; });
    team.spread(plan_.vertices, [&](int v) { a_.limits[v] = limits_none; });
    team.spread(body_.vertices, [&](int i) { want_vertex(i, displacement); });
    team.spread(plan_.vertices - plan_.body_vertices, [&](int n) {
      const int v = plan_.body_vertices + n;
      a_.target[v] = aims || env_.held(v) ? a_.goal[v] : a_.place[v];
    });
  }

  // A target out of the planes and spheres of the scene, with their friction.
  PD_HD void leave_walls(int i) const {
    if (!env_.walls.exist()) return;
    Vec3<T>& target = a_.target[body_.order[i]];
    const Vec3<T> u = body_.vertex(i).project(env_.walls, body_.displacement_to(target, i),
                                              BodyState<T>::read(body_.u, i));
    BodyState<T>::write(body_.free, i, u);
    target = body_.place(i, u);
  }

  // Closest points and normals at the present iterate.
  template <class Team>
  PD_HD void look(const Team& team, int pairs) const {
    team.each_closest(
        pairs, [&](int p) -> const auto& { return a_.pair[p]; }, a_.place,
        [&](int p, const Closest<T>& near) { a_.pair[p].look(near); });
  }

  // Finds whether a vertex wants to leave its ball, and whether a pair has a force. `walls`: targets leave them first
  PD_HD void watch_vertex(int v) const {
    Vec3<T> target = a_.target[v];
    if (move_into(a_.ball[v], target)) env_.numbers().outside = 1;
    a_.cut[v] = 0;
  }
  template <class Team>
  PD_HD void watch(const Team& team, int pairs, bool walls) const {
    ContactNumbers& numbers = env_.numbers();
    team.spread(pairs, [&](int p) {
      if (a_.pair[p].force.normal != T(0)) numbers.loaded = 1;
    });
    team.spread(body_.vertices, [&](int i) {
      if (walls) leave_walls(i);
      watch_vertex(body_.order[i]);
    });
    team.each(plan_.vertices - plan_.body_vertices,
              [&](int n) { watch_vertex(plan_.body_vertices + n); });
  }

  // Before the move of iteration k: a search if a vertex wants to leave its ball, else planes that
  // targets violate are made anew at the present iterate. Searches pause while pairs have forces.
  template <class Team>
  PD_HD void prepare(const Team& team, int k) const {
    ContactNumbers& numbers = env_.numbers();
    const int pairs = numbers.pairs, since = k - numbers.searched_at;
    const bool outside = numbers.outside != 0, due = since >= search_pause || !numbers.loaded;
    if (outside && due) {
      team.barrier();  // all have read
      team.once([&] { numbers.waits = 0, numbers.searched_at = k; });
      search_.find(team, false);
      return;
    }
    team.spread(1, [&](int) { numbers.waits = outside; });
    team.each(pairs, [&](int p) { renew(p, a_.target); });
  }

  // Makes the plane of a pair anew at the present iterate if places do not let it be.
  PD_HD void renew(int p, const Vec3<T>* to) const {
    ContactPair<T>& pair = a_.pair[p];
    if (!breaks(pair, to)) return;
    make_plane<T, const Vec3<T>*>(pair, a_.place, to, pair.near, pair.plane.normal);
    env_.keep_spaces(p);
  }

  // Moves toward the targets. `sums`: see iterate
  template <class Team>
  PD_HD void go(const Team& team, bool measures, double (&sums)[2]) const {
    const auto move = [&](int i, double (&sum)[2]) {
      const int v = body_.order[i];
      move_vertex(v);
      const Vec3<T> u = BodyState<T>::read(body_.u, i),
                    next = body_.displacement_to(a_.place[v], i), way = next - u;
      BodyState<T>::write(body_.u, i, next);
      BodyState<T>::write(body_.before, i, a_.cut[v] ? next : u);
      if (!measures) return;
      const Vec3<T> off = next - BodyState<T>::read(body_.target, i);
      sum[0] += double(dot(way, way));
      sum[1] += double(dot(off, off));
    };
    sums[0] = sums[1] = 0;
    // all have decided by them
    team.spread(1, [&](int) {
      ContactNumbers& numbers = env_.numbers();
      numbers.active = numbers.moved = numbers.outside = numbers.loaded = 0;
      for (int& change : numbers.changes) change = 0;
    });
    if (measures) {
      team.sum(body_.vertices, move, sums);
    } else {
      team.each(body_.vertices, [&](int i) {
        double none[2] = {};
        move(i, none);
      });
    }
    if (plan_.colliders > 0) move_hands(team, measures, sums);
  }

 private:
  PD_HD void cut(int v) const {
    a_.cut[v] = 1;
    env_.numbers().cut = 1;
    count_one(&env_.numbers().shortened);
  }

  PD_HD bool is_allowed_at(int v, const Vec3<T>& to) const {
    return is_allowed(to, a_.ball[v], [&](const auto& visit) { env_.each_space(v, visit); });
  }

  PD_HD void move_vertex(int v) const {
    const Vec3<T> from = a_.place[v];
    if (env_.held(v)) {
      const Vec3<T> goal = a_.goal[v], way = goal - from;
      const auto at = [&](T share) { return share < T(1) ? multiply_add(share, way, from) : goal; };
      const T share =
          env_.is_stuck(v) ? T(0) : largest_share<T>([&](T s) { return is_allowed_at(v, at(s)); });
      if (share > T(0)) a_.place[v] = at(share);
      if (share < T(1)) cut(v);
      return;
    }
    if (env_.is_stuck(v)) {
      cut(v);
      count_one(&env_.numbers().frozen);
      return;
    }
    Vec3<T> inside = a_.target[v];
    if (a_.limits[v] == limits_none && !move_into(a_.ball[v], inside)) {
      a_.place[v] = a_.target[v];  // planes and spheres of the scene have moved it
      return;
    }
    const LimitedPlace<T> to = limit(a_.target[v], from, a_.ball[v],
                                     [&](const auto& visit) { env_.each_space(v, visit); });
    a_.place[v] = to.place;
    if (to.shortened) cut(v);
  }

  // Colliders by the largest shares of their screws that all their vertices allow.
  template <class Team>
  PD_HD void move_hands(const Team& team, bool measures, double (&sums)[2]) const {
    ContactNumbers& numbers = env_.numbers();
    const int own = plan_.vertices - plan_.body_vertices;
    team.spread(1, [&](int) { numbers.stopped = 0; });
    team.each(plan_.colliders, [&](int c) {
      a_.barred[c] = 0;
      a_.screw[c] = Screw<T>(a_.hand[c].pose, a_.hand[c].goal);
      a_.share[c] = T(1);
    });
    // barred: 1 by the share that is tried, 2 by a frozen pair
    const auto try_shares = [&](bool all) {
      team.each(own, [&](int n) {
        const int v = plan_.body_vertices + n, c = plan_.collider[v];
        if (a_.hand[c].is_there()) return;
        if (all && env_.is_stuck(v)) {
          raise(a_.barred + c, 2);
        } else if ((all || a_.share[c] < a_.bound[c]) && a_.barred[c] == 0 &&
                   !is_allowed_at(v, a_.screw[c].at(a_.share[c]).place(local_point(plan_, v)))) {
          raise(a_.barred + c, 1);
        }
      });
    };
    try_shares(true);
    team.each(plan_.colliders, [&](int c) {
      a_.least[c] = a_.barred[c] ? T(0) : T(1);
      a_.bound[c] = a_.barred[c] == 1 ? T(1) : a_.least[c];  // no more trials
      if (a_.barred[c] == 1) numbers.stopped = 1;
    });
    const bool stopped = numbers.stopped != 0;
    // as largest_share
    for (int n = 0; stopped && n < share_halvings; ++n) {
      team.each(plan_.colliders, [&](int c) {
        a_.barred[c] = 0;
        a_.share[c] = T(0.5) * (a_.least[c] + a_.bound[c]);
      });
      try_shares(false);
      team.each(plan_.colliders,
                [&](int c) { (a_.barred[c] ? a_.bound[c] : a_.least[c]) = a_.share[c]; });
    }
    team.each(plan_.colliders, [&](int c) { a_.share[c] = a_.least[c]; });
    team.each(plan_.colliders, [&](int c) { a_.hand[c].pose = a_.screw[c].at(a_.share[c]); });
    const auto follow = [&](int n, double (&sum)[2]) {
      const int v = plan_.body_vertices + n, c = plan_.collider[v];
      const Vec3<T> to = a_.hand[c].pose.place(local_point(plan_, v)), way = to - a_.place[v],
                    off = to - a_.goal[v];
      a_.place[v] = to;
      if (a_.share[c] < T(1)) cut(v);
      if (!measures || !rigid_.is_rigid(c)) return;
      sum[0] += double(dot(way, way));
      sum[1] += double(dot(off, off));
    };
    if (measures && rigid_.exist()) {
      team.sum(own, follow, sums);
    } else {
      team.each(own, [&](int n) {
        double none[2] = {};
        follow(n, none);
      });
    }
  }

  const Env& env_;
  const ContactPlan<T>& plan_;
  const ContactArrays<T>& a_;
  const BodyState<T>& body_;
  const ContactSearch<T> search_;
  const RigidColliders<T, HasRigid> rigid_;
};

}  // namespace pd::inline PD_TARGET
