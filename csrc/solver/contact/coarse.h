// The coarse correction of bodies in contact: rigid motions that the listed pairs join, as far as other bodies let them.
#pragma once
#include "solver/coarse/island.h"
#include "solver/coarse/thin.h"
#include "solver/contact/schedule.h"
#include "solver/contact/shares.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasRigid>
class ContactCorrection : ContactShares<T, HasRigid> {
  using Base = ContactShares<T, HasRigid>;
  using Base::a_, Base::body_, Base::env_, Base::plan_, Base::rigid_;
  using Base::component_at, Base::is_valid, Base::moves, Base::narrow, Base::place_after,
      Base::pose_after, Base::position, Base::coarse_vertex, Base::wide;

 public:
  PD_HD explicit ContactCorrection(const ContactEnvironment<T>& env) : Base(env) {}

  // Islands of the components that listed pairs join, and of each other one that `touches`: a body that meets itself alone,
  // after the last iteration. `numbers.corrects`: whether there is one.
  template <class Team>
  PD_HD void begin(const Team& team) const {
    ContactNumbers& numbers = env_.numbers();
    const int pairs = numbers.pairs, count = env_.components();
    team.spread(1, [&](int) { numbers.corrects = numbers.searching = numbers.cuts = 0; });
    team.spread(std::int64_t(count) * count, [&](int n) { a_.couple[n] = 0; });
    team.each(count, [&](int g) {
      a_.root[g] = g, a_.side_start[g] = 0;
      a_.component_begin[g] = plan_.body_vertices, a_.component_end[g] = 0;
    });
    team.spread(pairs, [&](int p) {
      if (is_between(a_.pair[p])) numbers.corrects = 1;
    });
    team.spread(count, [&](int g) {
      if (a_.touches[g]) numbers.corrects = 1;
    });
    team.each(plan_.body_vertices, [&](int v) {
      const int g = a_.component[v];
      if (g < 0) return;
      lower(a_.component_begin + g, v);
      raise(a_.component_end + g, v + 1);
    });
    if (!numbers.corrects) return;
    team.groups(body_.components, [&](int g, const auto& group) { sum_body(g, group); });
    team.each(rigid_.count(), [&](int c) {
      const int g = body_.components + c;
      a_.coarse_body[g] = CoarseBody(rigid_.body_at(c, a_.hand[c].pose));
      a_.goes[g] = a_.coarse_body[g].moves();
    });
    team.each(pairs, [&](int p) {
      a_.joins[p] = joins(a_.pair[p]);
      if (!a_.joins[p]) return;
      const int a = component_of(p, 0), b = component_of(p, 1);
      if (a >= 0) count_one(a_.side_start + a);
      if (b >= 0) count_one(a_.side_start + b);
      if (a < 0 || b < 0) return;
      a_.couple[std::int64_t(a) * count + b] = a_.couple[std::int64_t(b) * count + a] = 1;
      join(a_.root, a, b);
    });
    team.scan(a_.side_start, count);
    team.groups(count, [&](int g, const auto& group) {
      if (a_.side_start[g] == a_.side_start[g + 1]) return;
      group.select(
          pairs,
          [&](int p) {
            return a_.joins[p] && (component_of(p, 0) == g || component_of(p, 1) == g);
          },
          a_.side_pair + a_.side_start[g]);
    });
    team.once([&] { lay_out(); });
    team.each(pairs, [&](int p) {
      if (a_.joins[p]) a_.radius[p] = pair_at(p).first_radius();
    });
  }

  // The displacement targets, shifted by the forces of pairs: the gradient of E with those targets is the sum of elements,
  // inertia and pairs, which planes and spheres answer.
  template <class Team>
  PD_HD void shift_targets(const Team& team) const {
    const int pairs = env_.numbers().pairs;
    team.each(pairs, [&](int p) { env_.keep_pushes(p); });
    team.each(body_.vertices, [&](int i) {
      const Vec3<T> target = BodyState<T>::read(body_.target, i);
      BodyState<T>::write(body_.saved, i, target);
      const T inertia = body_.inertia_of(i);
      if (!(body_.inverse_of(i) > T(0))) return;
      BodyState<T>::write(body_.target, i,
                          multiply_add(T(1) / inertia, env_.force_on(body_.order[i]), target));
    });
  }
  template <class Team>
  PD_HD void restore_targets(const Team& team) const {
    team.each(body_.vertices, [&](int i) {
      BodyState<T>::write(body_.target, i, BodyState<T>::read(body_.saved, i));
    });
  }

  // Moves all islands, with the forces of their pairs. Targets are where planes and spheres push from there.
  // `forces(i)`: those of planes and spheres on a vertex. `numbers.leaves`: a search must follow; `numbers.cuts`: a motion
  // was cut; `numbers.pushes`: targets are not the places.
  template <class Team, class Forces>
  PD_HD void move(const Team& team, const Forces& forces) const {
    ContactNumbers& numbers = env_.numbers();
    find_motions(team, forces);
    this->find_shares(team);
    const int pairs = numbers.pairs;
    team.each(pairs, [&](int p) {
      if (!a_.joins[p]) return;
      const int root = root_of_pair(p);
      if (!is_valid(root)) return;
      // those of the whole motion, which move colliders; else what is cut would be lost
      const auto whole = [&](int g) -> const RigidMotion<double>& {
        return a_.coarse_body[g].motion();
      };
      const auto motion = [&](int g) -> const RigidMotion<double>& { return a_.motion[g]; };
      const CoarsePair pair = pair_at(p);
      const Vec3<double> force = has_collider(p) ? pair.force_after(whole, a_.radius[p])
                                 : a_.coarse_share[root] < 1
                                     ? pair.force_after(motion, friction_after(pair, motion))
                                     : pair.force_changed_by(motion, a_.radius[p]);
      const double normal = dot(force, pair.normal);
      a_.pair[p].force = {T(normal > 0 ? normal : 0.0), narrow(tangential(force, pair.normal))};
    });
    team.each(plan_.vertices, [&](int v) {
      if (v >= plan_.body_vertices) {
        if (moves(v) && a_.coarse_share[a_.root[a_.component[v]]] > 0)
          a_.place[v] = place_after(v, a_.motion[a_.component[v]]);
        a_.target[v] = env_.held(v) ? a_.goal[v] : a_.place[v];
        return;
      }
      const int i = a_.inside[v], g = a_.component[v];
      const Vec3<T> u = BodyState<T>::read(body_.u, i);
      a_.checked[v] = u;
      a_.shift[v] = BodyState<T>::read(body_.before, i);
      Vec3<T> push = {T(0), T(0), T(0)};
      if (moves(v)) {
        const double share = a_.coarse_share[a_.root[g]];
        if (env_.walls.exist()) push = T(share) * wall_push(i, g, forces(i));
        if (share > 0) {
          a_.place[v] = place_after(v, a_.motion[g]);
          BodyState<T>::write(body_.u, i, a_.place[v] - BodyState<T>::read(body_.x, i));
        }
        if (dot(push, push) > T(0)) numbers.pushes = 1;
      }
      a_.target[v] = env_.held(v) ? a_.goal[v] : a_.place[v] + push;
    });
    team.each(rigid_.count(), [&](int c) {
      const int g = body_.components + c;
      Hand<T>& hand = a_.hand[c];
      if (a_.goes[g] && is_valid(a_.root[g]) && a_.coarse_share[a_.root[g]] > 0)
        hand.pose = pose_after(c, a_.motion[g]);
    });
    if (rigid_.exist()) rigid_.stay(team);
  }

  // The last iterate, shifted as this one.
  template <class Team>
  PD_HD void end(const Team& team) const {
    team.each(body_.vertices, [&](int i) {
      const int v = body_.order[i];
      BodyState<T>::write(body_.before, i,
                          a_.shift[v] + (BodyState<T>::read(body_.u, i) - a_.checked[v]));
    });
  }

 private:
  PD_HD int component_of(int p, int side) const {
    return component_at(a_.pair[p].vertex[side == 0 ? 0 : 3]);
  }
  PD_HD int root_of_pair(int p) const {
    const int a = component_of(p, 0);
    return a_.root[a >= 0 ? a : component_of(p, 1)];
  }
  // with a mass
  PD_HD bool has_collider(int p) const {
    return component_of(p, 0) >= body_.components || component_of(p, 1) >= body_.components;
  }
  template <class Motion>
  PD_HD static double friction_after(const CoarsePair& pair, const Motion& motion) {
    const Surface<double> at = pair.after(pair.move_of(motion));
    return pair.friction * pair.envelope().normal_force(at.gap);
  }
  PD_HD bool is_between(const ContactPair<T>& pair) const {
    return a_.component[pair.vertex[0]] != a_.component[pair.vertex[3]];
  }
  // a pair of different components that can yield
  PD_HD bool joins(const ContactPair<T>& pair) const {
    return component_at(pair.vertex[0]) != component_at(pair.vertex[3]) &&
           pair.can_yield(a_.inverse);
  }
  PD_HD Vec3<double> position_of(int v) const {
    return v < plan_.body_vertices ? position(a_.inside[v]) : wide(a_.place[v]);
  }

  // The quadratics of a component.
  template <class Group>
  PD_HD void sum_body(int g, const Group& group) const {
    using S = RigidSums;
    const auto add_up = [&](auto& sums, const auto& add) {
      group.sum_range(
          a_.component_begin[g], a_.component_end[g],
          [&](int v, auto& sum) {
            if (a_.component[v] != g) return;
            const int i = a_.inside[v];
            add(i, double(body_.inertia_of(i)), sum);
          },
          sums);
    };
    double mean[S::target_offset] = {}, moments[S::pins - S::target_offset] = {},
           pins[S::count - S::pins] = {}, sums[S::count];
    add_up(mean, [&](int i, double a, auto& sum) { add_mean(sum, a, position(i)); });
    const Vec3<double> center = center_of(mean);
    add_up(moments, [&](int i, double a, auto& sum) {
      const Vec3<T> offset = BodyState<T>::read(body_.target, i) - BodyState<T>::read(body_.u, i);
      add_moments(sum, a, position(i) - center, wide(offset));
    });
    add_up(pins, [&](int i, double a, auto& sum) { add_pin(sum, a, position(i)); });
    if (!group.leads()) return;
    for (int n = 0; n < S::count; ++n)
      sums[n] = n < S::target_offset ? mean[n]
                : n < S::pins        ? moments[n - S::target_offset]
                                     : pins[n - S::pins];
    RigidBody body(sums);
    resist_thin_turns(body);
    a_.coarse_body[g] = CoarseBody(body);
    a_.goes[g] = a_.coarse_body[g].moves();
  }

  // Members of islands, one after another.
  PD_HD void lay_out() const {
    const int count = env_.components();
    ContactNumbers& numbers = env_.numbers();
    for (int g = 0; g < count; ++g) {
      a_.root[g] = root_of(a_.root, g);
      a_.size[g] = a_.valid[g] = 0;
      const bool joined = a_.side_start[g] < a_.side_start[g + 1],
                 moves = a_.touches[g] && a_.goes[g];
      a_.local[g] = joined || moves ? a_.size[a_.root[g]]++ : -1;
    }
    int first = 0;
    for (int g = 0; g < count; first += a_.size[g++]) a_.first[g] = first;
    double* matrix = a_.matrix;
    for (int g = 0; g < count; ++g) {
      if (a_.local[g] >= 0) a_.member[a_.first[a_.root[g]] + a_.local[g]] = g;
    }
    for (int g = 0; g < count; ++g) {
      const int own = a_.size[g];
      if (own == 0) continue;
      a_.island[g] = CoarseIsland(a_.coarse_body, a_.member + a_.first[g], own, matrix,
                                  a_.newton + 18 * a_.first[g]);
      matrix += CoarseIsland::entries_of(own);
      if (!a_.island[g].is_done()) numbers.searching = 1;
    }
  }

  PD_HD CoarsePair pair_at(int p) const {
    const ContactPair<T>& of = a_.pair[p];
    CoarsePair pair;
    for (int s = 0; s < 2; ++s) {
      const int g = component_of(p, s);
      pair.side[s] = {g, {0, 0, 0}};
      if (g < 0) continue;
      const Vec3<double>& center = a_.coarse_body[g].motion().center;
      for (int c = 0; c < 4; ++c) {
        if (of.on_a(c) != (s == 0)) continue;
        const double share = s == 0 ? double(of.near.weight[c]) : -double(of.near.weight[c]);
        pair.side[s].arm =
            multiply_add(share, position_of(of.vertex[c]) - center, pair.side[s].arm);
      }
    }
    pair.normal = wide(of.normal);
    pair.slip = wide(of.template slip<const Vec3<T>*>(a_.place, a_.begin, of.near));
    pair.force = multiply_add(double(of.force.normal), pair.normal,
                              tangential(wide(of.force.tangential), pair.normal));
    pair.gap = double(of.near.distance) - double(of.thickness);
    pair.yielding = double(of.yielding(a_.inverse));
    pair.friction = double(of.friction);
    return pair;
  }

  // The motions of all islands with the least energy.
  template <class Team, class Forces>
  PD_HD void find_motions(const Team& team, const Forces& forces) const {
    ContactNumbers& numbers = env_.numbers();
    const int pairs = numbers.pairs, count = env_.components();
    bool searching = numbers.searching != 0;
    while (searching) {
      team.each(pairs, [&](int p) {
        if (!a_.joins[p]) return;
        const CoarseIsland& island = a_.island[root_of_pair(p)];
        if (!island.is_done())
          a_.terms[p] = terms_of(pair_at(p), a_.coarse_body, island.renews(), a_.radius[p]);
      });
      team.groups(count, [&](int g, const auto& group) {
        if (searches(g)) sum_forces(g, group, forces);
      });
      // all threads have read it before the passes above
      team.spread(1, [&](int) { numbers.searching = 0; });
      team.groups(count * count, [&](int n, const auto& group) {
        const int row = n / count, column = n % count;
        if (column < row && a_.root[row] == a_.root[column] && searches(row) && searches(column))
          sum_couple(row, column, group);
      });
      team.groups(count, [&](int g, const auto& group) {
        if (a_.size[g] == 0 || a_.island[g].is_done()) return;
        a_.island[g].pass(group, a_.coarse_sum);
        if (group.leads() && !a_.island[g].is_done()) numbers.searching = 1;
      });
      searching = numbers.searching != 0;
    }
    team.each(count, [&](int g) {
      if (a_.size[g] > 0) a_.valid[g] = a_.island[g].is_valid();
    });
  }

  // a component of an island that is not done
  PD_HD bool searches(int g) const { return a_.local[g] >= 0 && !a_.island[a_.root[g]].is_done(); }

  // What planes, spheres and pairs add to a component.
  template <class Group, class Forces>
  PD_HD void sum_forces(int g, const Group& group, const Forces& forces) const {
    double sums[ContactSums::count] = {};
    if (env_.walls.exist()) {
      const CoarseTrial<double> trial = a_.island[a_.root[g]].trial_of(a_.coarse_body[g]);
      group.add_range(a_.component_begin[g], a_.component_end[g], [&](int v) {
        if (a_.component[v] != g) return;
        const int i = a_.inside[v];
        each_contact_term(env_.walls, coarse_vertex(i), trial, forces(i),
                          [&](bool adds, const auto& terms) {
                            if (adds) add_terms(sums, terms());
                          });
      });
    }
    group.add_range(a_.side_start[g], a_.side_start[g + 1], [&](int n) {
      const int p = a_.side_pair[n], a = component_of(p, 0), side = a == g ? 0 : 1;
      const PairTerms& of = a_.terms[p];
      const bool counts = side == 0 || a < 0;
      if (of.resists()) return add_terms(sums, of.of_side(side, counts));
      if (counts) sums[ContactSums::before] += of.before;  // no force: the other numbers are 0
    });
    group.add_up(sums);
    if (!group.leads()) return;
    for (int n = 0; n < ContactSums::count; ++n)
      a_.coarse_sum[g * ContactSums::count + n] = sums[n];
  }

  template <class Group>
  PD_HD void sum_couple(int row, int column, const Group& group) const {
    double sums[CoupleSums::count] = {};
    if (a_.couple[std::int64_t(row) * env_.components() + column]) {
      group.sum_range(
          a_.side_start[row], a_.side_start[row + 1],
          [&](int n, auto& sum) {
            const int p = a_.side_pair[n], side = component_of(p, 0) == row ? 0 : 1;
            if (component_of(p, 1 - side) == column && a_.terms[p].resists())
              add_couple(sum, a_.terms[p], side);
          },
          sums);
    }
    if (group.leads()) a_.island[a_.root[row]].set_couple(a_.local[row], a_.local[column], sums);
  }

  // What planes and spheres push after the whole motion of a component.
  template <class Forces>
  PD_HD Vec3<T> wall_push(int i, int g, const Forces& forces) const {
    const auto vertex = body_.vertex(i);
    CoarseVertex<double> v = coarse_vertex(i);
    const Vec3<T> u = BodyState<T>::read(body_.u, i);
    const Vec3<T> moved = vertex.displaced(u, narrow(a_.coarse_body[g].motion().of(v.x + v.u)));
    v.u = wide(moved);
    const Vec3<T> out = vertex.displaced(moved, narrow(push_of(env_.walls, v, forces)));
    return vertex.project(env_.walls, out, out) - moved;
  }
};

}  // namespace pd::inline PD_TARGET
