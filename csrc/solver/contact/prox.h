// The proximal step of an iteration: multipliers in the metric of D, and what they move; see contact/pairs/multiplier.h.
//
// Pairs that have a force or would come too near lie in rows, side by side. A sweep takes blocks of them: a GPU's thread
// one, the CPU as many as a vector register holds. Forces are added to vertices in the order of the pairs: by pairs where
// a team takes items in order, else by vertices, over their entries.
#pragma once
#include "solver/contact/rigid.h"

namespace pd::inline PD_TARGET {

template <class T>
class ContactProx {
 public:
  using Env = ContactEnvironment<T>;
  using Rows = ActiveRows<T>;

  PD_HD explicit ContactProx(const Env& env)
      : env_(env), a_(env.a), rows_(env.a.rows, env.plan.capacity), rigid_(env) {}

  // Moves targets and forces. c = theta omega
  template <class Team>
  PD_HD void run(const Team& team, T c) const {
    ContactNumbers& numbers = env_.numbers();
    team.each(numbers.pairs, [&](int p) { take<Team>(p, c); });
    const int active = numbers.active, moved = numbers.moved;
    if (active == 0) return;
    push(team, active, moved, c, true);
    if (rigid_.exist()) rigid_.begin(team, active);
    for (int sweep = 0; sweep < contact_sweeps; ++sweep) {
      if (rigid_.exist()) rigid_.move(team, active, moved);
      team.template blocks<T>(active, [&](const auto& lanes) {
        advance<Team>(lanes, numbers.changes[sweep], sweep == 0);
      });
      // a further sweep would change nothing either
      if (!numbers.changes[sweep]) break;
      push(team, active, moved, c, false);
    }
    team.spread(active, [&](int q) {
      a_.pair[rows_.pair(q)].force = {
          rows_.at(Rows::normal_force, q),
          {rows_.at(Rows::tangential, q), rows_.at(Rows::tangential + 1, q),
           rows_.at(Rows::tangential + 2, q)}};
    });
    team.each(moved, [&](int n) {
      const int v = a_.moved[n];
      const Four<T> by = a_.moved_by[v];
      a_.target[v] = a_.target[v] + Vec3<T>{by.x, by.y, by.z};
      a_.touched[v] = 0;
    });
  }

 private:
  // Takes a pair among the active ones.
  template <class Team>
  PD_HD void take(int p, T c) const {
    ContactPair<T>& pair = a_.pair[p];
    Vec3<T> corner[4];
    pair.corners(a_.target, corner);
    const Vec3<T> between = combined(pair.near.weight, corner);
    const bool acts = pair.force.normal > T(0) || !(pair.thickness <= dot(pair.normal, between)),
               active = acts && pair.can_yield(a_.inverse);
    if (acts && !active) pair.force = {};  // nothing can yield
    if constexpr (!Team::in_order) {
      if (a_.active[p] && !active) env_.keep_pushes(p, false);
      a_.active[p] = active;
    }
    if (!active) return;
    const int q = count_one(&env_.numbers().active);
    rows_.pair(q) = p;
    const auto put = [&](int row, const Vec3<T>& from) {
      rows_.at(row, q) = from.x, rows_.at(row + 1, q) = from.y, rows_.at(row + 2, q) = from.z;
    };
    Vec3<T> before[4];
    pair.corners(a_.begin, before);
    put(Rows::between, between);
    put(Rows::before, combined(pair.near.weight, before));
    put(Rows::normal, pair.normal);
    put(Rows::tangential, pair.force.tangential);
    put(Rows::force, multiply_add(pair.force.normal, pair.normal, pair.force.tangential));
    rows_.at(Rows::normal_force, q) = pair.force.normal;
    rows_.at(Rows::thickness, q) = pair.thickness;
    rows_.at(Rows::friction, q) = pair.friction;
    for (int corner = 0; corner < 4; ++corner) {
      const int v = pair.vertex[corner];
      const T weight = pair.near.weight[corner];
      rows_.vertex(corner, q) = v;
      rows_.at(Rows::weight + corner, q) = weight;
      rows_.at(Rows::moves + corner, q) = c * weight * a_.inverse[v];
      if (take_first(a_.touched + v)) a_.moved[count_one(&env_.numbers().moved)] = v;
    }
    if constexpr (!Team::in_order) keep_push(q);
  }

  PD_HD void keep_push(int q) const {
    for (int corner = 0; corner < 4; ++corner)
      a_.push[a_.slot[4 * rows_.pair(q) + corner]] = {
          rows_.at(Rows::force, q), rows_.at(Rows::force + 1, q), rows_.at(Rows::force + 2, q),
          rows_.at(Rows::weight + corner, q)};
  }

  // How forces move the vertices; `first`: and S of every vertex.
  template <class Team>
  PD_HD void push(const Team& team, int active, int moved, T c, bool first) const {
    if constexpr (Team::in_order) {
      team.each(moved, [&](int n) {
        a_.moved_by[a_.moved[n]] = {T(0), T(0), T(0), T(0)};
        if (first) a_.weight[a_.moved[n]] = T(0);
      });
      team.each(active, [&](int q) {
        const Four<T> force{rows_.at(Rows::force, q), rows_.at(Rows::force + 1, q),
                            rows_.at(Rows::force + 2, q), T(0)};
        PD_UNROLL
        for (int corner = 0; corner < 4; ++corner) {
          const int v = rows_.vertex(corner, q);
          if (first) a_.weight[v] = a_.weight[v] + absolute(rows_.at(Rows::weight + corner, q));
          a_.moved_by[v] = multiply_add(rows_.at(Rows::moves + corner, q), force, a_.moved_by[v]);
        }
      });
    } else {
      team.each(moved, [&](int n) {
        const int v = a_.moved[n], end = a_.start[v + 1];
        const T inverse = a_.inverse[v];
        Four<T> by{T(0), T(0), T(0), T(0)};
        T weight(0);
        PD_UNROLL_4
        for (int entry = a_.start[v]; entry < end; ++entry) {
          const Four<T> of = a_.push[entry];
          weight = weight + absolute(of.w);
          by = multiply_add(c * of.w * inverse, of, by);
        }
        a_.moved_by[v] = by;
        if (first) a_.weight[v] = weight;
      });
    }
  }

  template <class Team, class Lanes>
  PD_HD void advance(const Lanes& lanes, int& changes, bool first) const {
    using P = typename Lanes::Number;
    if (first) {
      lanes.each([&](int q) {
        T sum(0);
        for (int corner = 0; corner < 4; ++corner)
          sum = multiply_add(absolute(rows_.at(Rows::moves + corner, q)),
                             a_.weight[rows_.vertex(corner, q)], sum);
        rows_.at(Rows::beta, q) = T(1) / sum;
      });
    }
    const auto load = [&](int row) { return lanes.load(rows_.row(row)); };
    const auto vector = [&](int row) { return Vec3<P>{load(row), load(row + 1), load(row + 2)}; };
    const auto store = [&](int row, const Vec3<P>& value) {
      lanes.store(rows_.row(row), value.x);
      lanes.store(rows_.row(row + 1), value.y);
      lanes.store(rows_.row(row + 2), value.z);
    };
    const Vec3<P> moved = lanes.vector([&](int q) {
      const auto by = [&](int corner) { return a_.moved_by[rows_.vertex(corner, q)]; };
      const auto weight = [&](int corner) { return rows_.at(Rows::weight + corner, q); };
      Four<T> sum = multiply_add(weight(0), by(0), Four<T>{T(0), T(0), T(0), T(0)});
      for (int corner = 1; corner < 4; ++corner)
        sum = multiply_add(weight(corner), by(corner), sum);
      return sum;
    });
    const Vec3<P> normal = vector(Rows::normal);
    const Multiplier<P> old{load(Rows::normal_force), vector(Rows::tangential)};
    const Multiplier<P> next =
        pd::advance(old, load(Rows::beta), load(Rows::thickness), load(Rows::friction), normal,
                    vector(Rows::between) + moved, vector(Rows::before));
    lanes.store(rows_.row(Rows::normal_force), next.normal);
    store(Rows::tangential, next.tangential);
    store(Rows::force, multiply_add(next.normal, normal, next.tangential));
    const auto same = [](const P& a, const P& b) { return a <= b && b <= a; };
    const Vec3<P>&was = old.tangential, &is = next.tangential;
    if (!lanes.all(same(old.normal, next.normal) && same(was.x, is.x) && same(was.y, is.y) &&
                   same(was.z, is.z)))
      changes = 1;
    if constexpr (!Team::in_order) lanes.each([&](int q) { keep_push(q); });
  }

  const Env& env_;
  const ContactArrays<T>& a_;
  const Rows rows_;
  const RigidColliders<T> rigid_;
};

}  // namespace pd::inline PD_TARGET
