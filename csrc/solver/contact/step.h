// One step with contact between bodies, for a team: what lies between the passes over elements. A runner calls
//
//   start; [coarse correction] go_first; for k: [free iterate, energy] iterate(k);
//   [coarse correction] go_last; finish; write
#pragma once
#include "solver/contact/coarse.h"
#include "solver/contact/moves.h"
#include "solver/contact/prox.h"

namespace pd::inline PD_TARGET {

// `HasRigid`: with colliders that have a mass.
template <class T, bool HasRigid>
class ContactSteps {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit ContactSteps(const Env& env)
      : env_(env),
        plan_(env.plan),
        a_(env.a),
        body_(env.body),
        search_(env),
        correction_(env),
        prox_(env),
        rigid_(env),
        moves_(env) {}

  // A step begins at the places of bodies; poses are those of colliders, actual ones and those of the step's end.
  template <class Team>
  PD_HD void start(const Team& team) const {
    team.spread(plan_.vertices,
                [&](int v) { a_.surface[v] = 0, a_.limits[v] = a_.touched[v] = 0; });
    team.spread(body_.vertices, [&](int i) {
      const int v = body_.order[i];
      a_.inside[v] = i, a_.component[v] = body_.component[i];
      a_.place[v] = a_.begin[v] = body_.place(i, {T(0), T(0), T(0)});
      a_.inverse[v] = body_.inverse_of(i);
      a_.held[v] = !(body_.inverse_of(i) > T(0));
      a_.goal[v] = body_.place(i, BodyState<T>::read(body_.target, i));
    });
    team.each(plan_.vertices - plan_.body_vertices, [&](int n) {
      const int v = plan_.body_vertices + n, c = plan_.collider[v];
      const bool first = n == 0 || plan_.collider[v - 1] != c,
                 last = v + 1 == plan_.vertices || plan_.collider[v + 1] != c;
      const Pose<T> pose = Hand<T>::read(env_.poses + 7 * c),
                    goal = Hand<T>::read(env_.goal_poses + 7 * c);
      if (first) a_.hand[c].pose = pose, a_.hand[c].goal = goal, a_.hand[c].begin = v;
      if (last) a_.hand[c].end = v + 1;
      a_.place[v] = a_.begin[v] = pose.place(local_point(plan_, v));
      a_.goal[v] = goal.place(local_point(plan_, v));
      a_.inverse[v] = T(0);
      a_.held[v] = 1;
      a_.component[v] = -1;
    });
    if (rigid_.exist()) rigid_.start(team);
    team.spread(plan_.points, [&](int n) { a_.surface[plan_.point[n]] = 1; });
    team.once([&] {
      ContactNumbers numbers = {};
      // keys increase, and -1 pads them
      int begin = 0, end = plan_.capacity;
      while (begin < end) {
        const int middle = (begin + end) / 2;
        if (env_.history_key[middle] >= 0) {
          begin = middle + 1;
        } else {
          end = middle;
        }
      }
      numbers.known = begin;
      env_.numbers() = numbers;
    });
    search_.begin(team);
  }

  // Approach, search and the first iterate, as near to the corrected guess as the promise allows.
  template <class Team>
  PD_HD void go_first(const Team& team) const {
    const ContactApproach<T> approach(env_);
    const int known = env_.numbers().known;
    restore_touching(team, [&](const auto& touch) {
      team.each(known, [&](int n) {
        const std::int64_t of = env_.history_key[n];
        const bool edges = of >= first_edge_key(plan_);
        const std::int64_t key = edges ? of - first_edge_key(plan_) : of,
                           count = edges ? plan_.edges : plan_.triangles;
        const int a = edges ? plan_.edge[2 * (key / count)] : int(key / count),
                  b = edges ? plan_.edge[2 * (key % count)] : plan_.triangle[3 * (key % count)];
        if (plan_.body[a] == plan_.body[b]) return;
        touch(a);
        touch(b);
      });
    });
    moves_.want(team, body_.u, true);
    team.barrier();
    approach.move(team);
    search_.find(team, true);
    // What was stopped starts where it was: nearer to its guess it would only be squashed.
    team.each(plan_.vertices, [&](int v) {
      a_.cut[v] = 0;
      if (!env_.held(v) && approach.was_stopped(plan_.body[v])) a_.target[v] = a_.place[v];
    });
    team.spread(rigid_.count(), [&](int c) {
      Hand<T>& hand = a_.hand[c];
      if (rigid_.is_rigid(c) && approach.was_stopped(plan_.body[hand.begin])) hand.goal = hand.pose;
    });
    double none[2];
    moves_.go(team, false, none);
    team.each(body_.vertices,
              [&](int i) { BodyState<T>::write(body_.before, i, BodyState<T>::read(body_.u, i)); });
    team.each(env_.components(), [&](int g) { a_.touches[g] = 0; });
  }

  // At the end bodies that touch nothing are corrected again. `touches` has those that the last correction takes.
  template <class Team>
  PD_HD void go_last(const Team& team, int iterations) const {
    if (body_.components == 0) return;
    const int pairs = env_.numbers().pairs;
    restore_touching(team, [&](const auto& touch) {
      team.each(pairs, [&](int p) {
        touch(a_.pair[p].vertex[0]);
        touch(a_.pair[p].vertex[3]);
      });
    });
    moves_.want(team, body_.u, false);
    if (rigid_.exist()) rigid_.stay(team);
    team.barrier();
    moves_.watch(team, pairs, false);
    moves_.prepare(team, iterations);
    double none[2];
    moves_.go(team, false, none);
  }

  // The coarse correction of bodies in contact. In between, where planes and spheres exist, the runner keeps their forces
  // at the gradient by the targets of now. Returns whether there is something to correct.
  template <class Team>
  PD_HD bool begin_correction(const Team& team) const {
    if (env_.components() == 0) return false;
    moves_.look(team, env_.numbers().pairs);
    correction_.begin(team);
    if (!env_.numbers().corrects) return false;
    if (env_.walls.exist()) correction_.shift_targets(team);
    return true;
  }

  // `forces(i)`: those that the runner has kept. Returns whether a motion was cut.
  template <class Team, class Forces>
  PD_HD bool correct(const Team& team, const Forces& forces) const {
    ContactNumbers& numbers = env_.numbers();
    if (env_.walls.exist()) correction_.restore_targets(team);
    correction_.move(team, forces);
    const bool cuts = numbers.cuts != 0, pushes = numbers.pushes != 0;
    team.spread(1, [&](int) { numbers.checked = numbers.cut = 0; });
    team.spread(plan_.vertices, [&](int v) { a_.cut[v] = 0, a_.limits[v] = limits_none; });
    team.each(body_.vertices, [&](int i) { moves_.leave_walls(i); });
    if (numbers.leaves) search_.find(team, false);
    const int pairs = numbers.pairs;
    moves_.look(team, pairs);
    team.each(pairs, [&](int p) {
      moves_.renew(p, a_.place);
      if (pushes) moves_.renew(p, a_.target);
    });
    if (pushes) {
      double none[2];
      moves_.go(team, false, none);
    }
    correction_.end(team);
    return cuts;
  }

  // An iteration of a step, from the free iterate without contact. `energy`: E at the iterate, if
  // the schedule checks it. `sums`: squares of the change, and of the displacement from the target,
  // with a tolerance.
  struct Iteration {
    T c;  // theta omega
    bool guards, measures;
    double energy;
  };
  struct Merits {
    double before, now;
    bool known;
  };
  template <class Team>
  PD_HD Merits iterate(const Team& team, int k, const Iteration& of, double (&sums)[2]) const {
    const int pairs = env_.numbers().pairs;
    Merits merits{};
    if (pairs == 0 && !of.guards) {
      team.spread(1, [&](int) { env_.numbers().cut = 0; });
      team.spread(plan_.vertices, [&](int v) { a_.limits[v] = limits_none; });
      team.spread(body_.vertices, [&](int i) {
        moves_.want_vertex(i, body_.free);
        moves_.leave_walls(i);
        moves_.watch_vertex(body_.order[i]);
      });
      team.each(plan_.vertices - plan_.body_vertices, [&](int n) {
        a_.target[plan_.body_vertices + n] = a_.goal[plan_.body_vertices + n];
        moves_.watch_vertex(plan_.body_vertices + n);
      });
      if (rigid_.exist()) rigid_.aim(team);
    } else {
      moves_.want(team, body_.free, false);
      team.barrier();
      prox_.take(team, pairs, of.c);
      if (of.guards)
        merits = check(team, pairs, rigid_.exist() ? of.energy + rigid_.energy(team) : of.energy);
      prox_.run(team);
      if (rigid_.exist()) rigid_.aim(team);
      moves_.watch(team, pairs, true);
    }
    moves_.prepare(team, k);
    moves_.go(team, of.measures, sums);
    return merits;
  }

  // whether all go as they want
  PD_HD bool is_at_rest() const { return !env_.numbers().cut && !env_.numbers().waits; }

  // whether pairs exceed the capacity
  PD_HD bool overflows() const { return env_.numbers().most_pairs > plan_.capacity; }

  // At the end of a step: forces on every vertex [vertices, 3] N.
  template <class Team>
  PD_HD void finish(const Team& team, T* forces) const {
    const int pairs = env_.numbers().pairs;
    moves_.look(team, pairs);
    team.each(plan_.colliders + 2,
              [&](int n) { a_.most[n] = n < plan_.colliders + 1 ? T(0) : T(HUGE_VAL); });
    team.each(pairs, [&](int p) {
      const ContactPair<T>& pair = a_.pair[p];
      lower(a_.most + plan_.colliders + 1, pair.near.distance / pair.thickness);
      env_.keep_pushes(p);
    });
    team.each(plan_.vertices, [&](int v) {
      const Vec3<T> force = env_.force_on(v);
      T* const to = forces + 3 * std::int64_t(v);
      to[0] = force.x, to[1] = force.y, to[2] = force.z;
      if (!env_.held(v)) return;
      const int number = v < plan_.body_vertices ? plan_.colliders : plan_.collider[v];
      const Vec3<T> left = a_.place[v] - a_.goal[v];
      raise(a_.most + number, square_root(dot(left, left)));
    });
    if (!rigid_.exist()) return;
    team.groups(plan_.colliders, [&](int c, const auto& group) {
      if (!rigid_.is_rigid(c)) return;
      const double rest = rigid_.find_rest(c, group);
      if (group.leads()) a_.most[c] = T(rest);
    });
    team.barrier();
  }

  // An overflow takes the step back: then nothing has changed, and no force acts.
  template <class Team>
  PD_HD void write(const Team& team, const ContactOutput<T>& to) const {
    const ContactNumbers& numbers = env_.numbers();
    const bool overflows = this->overflows();
    const int pairs = overflows ? 0 : numbers.pairs;
    team.each(pairs, [&](int p) { a_.entry[p] = a_.pair[p].has_force(); });
    team.scan(a_.entry, pairs);
    const int count = a_.entry[pairs];
    team.spread(pairs, [&](int p) {
      const int at = a_.entry[p];
      if (a_.entry[p + 1] == at) return;
      to.write_force(at, a_.pair[p].key, a_.pair[p].force);
    });
    team.spread(plan_.capacity, [&](int n) {
      const T* f = env_.history_force + 4 * std::int64_t(n);
      if (overflows) {
        to.write_force(n, env_.history_key[n], {f[0], {f[1], f[2], f[3]}});
      } else if (n >= count) {
        to.write_force(n, -1, {});
      }
    });
    if (overflows) team.spread(3 * plan_.vertices, [&](int n) { to.vertex_forces[n] = T(0); });
    team.spread(plan_.colliders, [&](int c) {
      const Pose<T> pose = overflows ? Hand<T>::read(env_.poses + 7 * c) : a_.hand[c].pose;
      Hand<T>::write(pose, to.poses + 7 * c);
      to.held_back[c] = a_.most[c];
    });
    team.once([&] {
      to.info[contact_gap] = double(a_.most[plan_.colliders + 1]);
      to.info[contact_overflow] = overflows ? double(numbers.most_pairs - plan_.capacity) : 0;
      to.info[contact_pairs] = numbers.most_pairs;
      to.info[contact_searches] = numbers.searches;
      to.info[contact_shortened] = numbers.shortened;
      to.info[contact_frozen] = numbers.frozen;
      to.info[contact_pins_held_back] = double(a_.most[plan_.colliders]);
      to.info[contact_residual] = to.report ? rigid_.residual() : NAN;
    });
  }

 private:
  // Takes back the coarse correction of components with a vertex of each_touching(touch).
  template <class Team, class Each>
  PD_HD void restore_touching(const Team& team, const Each& each_touching) const {
    if (body_.components == 0) return;
    team.each(body_.components, [&](int g) { a_.touches[g] = 0; });
    each_touching([&](int v) {
      const int g = v < plan_.body_vertices ? a_.component[v] : -1;
      if (g >= 0) a_.touches[g] = 1;
    });
    team.each(body_.vertices, [&](int i) {
      const int g = body_.component[i];
      if (g >= 0 && a_.touches[g])
        BodyState<T>::write(body_.u, i, BodyState<T>::read(body_.saved, i));
    });
  }

  // E + psi at the last check and now, both by the list and the multipliers of now.
  template <class Team>
  PD_HD Merits check(const Team& team, int pairs, double energy) const {
    ContactNumbers& numbers = env_.numbers();
    const bool checked = numbers.checked != 0;
    double sums[2] = {numbers.checked_energy, energy};
    const auto psi = [&](const ContactPair<T>& pair, const Vec3<T>* places, const Closest<T>& at) {
      if (!(pair.force.normal > T(0)) && !(at.distance < pair.thickness)) return 0.0;
      return augmented_lagrangian(pair.force, pair.yielding(a_.inverse), pair.thickness,
                                  pair.friction, at.distance,
                                  pair.template slip<const Vec3<T>*>(places, a_.begin, at));
    };
    if (checked) {
      team.each_closest(
          pairs, [&](int p) -> const auto& { return a_.pair[p]; }, a_.checked,
          [&](int p, const Closest<T>& near) { a_.radius[p] = psi(a_.pair[p], a_.checked, near); });
    }
    team.sum(
        pairs,
        [&](int p, double (&sum)[2]) {
          if (checked) sum[0] += a_.radius[p];
          sum[1] += psi(a_.pair[p], a_.place, a_.pair[p].near);
        },
        sums);
    team.spread(plan_.vertices, [&](int v) { a_.checked[v] = a_.place[v]; });
    team.once([&] { numbers.checked_energy = energy, numbers.checked = 1; });
    return {sums[0], sums[1], checked};
  }

  const Env& env_;
  const ContactPlan<T>& plan_;
  const ContactArrays<T>& a_;
  const BodyState<T>& body_;
  const ContactSearch<T> search_;
  const ContactCorrection<T, HasRigid> correction_;
  const ContactProx<T, HasRigid> prox_;
  const RigidColliders<T, HasRigid> rigid_;
  const ContactMoves<T, HasRigid> moves_;
};

}  // namespace pd::inline PD_TARGET
