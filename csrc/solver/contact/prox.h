// The proximal step of an iteration: multipliers in the metric of D, and what they move; see contact/pairs/multiplier.h.
//
// Pairs that have a force or would come too near lie in rows, side by side. A sweep takes blocks of them: a GPU's thread
// one, the CPU as many as a vector register holds. Forces are added to vertices in the order of the pairs: by pairs where
// a team takes items in order, else by vertices, over their entries.
#pragma once
#include "solver/contact/rigid.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasRigid>
class ContactProx {
 public:
  using Env = ContactEnvironment<T>;
  using Row = ActiveRow<T>;

  PD_HD explicit ContactProx(const Env& env)
      : env_(env), a_(env.a), rows_{env.a.first_rows, env.a.rows}, rigid_(env) {}

  // Closest points at the present iterate, and the pairs that are active. c = theta omega
  template <class Team>
  PD_HD void take(const Team& team, int pairs, T c) const {
    team.each_closest(
        pairs, [&](int p) -> const auto& { return a_.pair[p]; }, a_.place,
        [&](int p, const Closest<T>& near) { take_pair<Team>(p, near, c); });
  }

  // After take. Moves targets and forces.
  template <class Team>
  PD_HD void run(const Team& team) const {
    ContactNumbers& numbers = env_.numbers();
    const int active = numbers.active, moved = numbers.moved;
    if (active == 0) return;
    push(team, active, moved, true);
    if (rigid_.exist()) rigid_.begin(team, active);
    for (int sweep = 0; sweep < contact_sweeps; ++sweep) {
      if (rigid_.exist()) rigid_.move(team, active, moved, sweep == 0);
      team.template blocks<T>(active, [&](const auto& lanes) {
        advance(lanes, numbers.changes[sweep], sweep == 0 && !rigid_.exist());
      });
      // a further sweep would change nothing either
      if (!numbers.changes[sweep]) break;
      push(team, active, moved, false);
    }
    team.spread(active, [&](int q) {
      const Row row = rows_[q];
      a_.pair[row.pair()].force = {row[Row::normal_force], vector(row, Row::tangential)};
    });
    team.each(moved, [&](int n) {
      const int v = a_.moved[n];
      const Four<T> by = a_.moved_by[v];
      a_.target[v] = a_.target[v] + Vec3<T>{by.x, by.y, by.z};
      a_.touched[v] = 0;
    });
  }

 private:
  template <class Team>
  PD_HD void take_pair(int p, const Closest<T>& near, T c) const {
    ContactPair<T>& pair = a_.pair[p];
    pair.look(near);
    Vec3<T> corner[4];
    pair.corners(a_.target, corner);
    const Vec3<T> between = combined(pair.near.weight, corner);
    const bool acts = pair.force.normal > T(0) || !(pair.thickness <= dot(pair.normal, between)) ||
                      (rigid_.exist() && rigid_.would_meet(pair)),
               active = acts && pair.can_yield(a_.inverse);
    if (acts && !active) pair.force = {};  // nothing can yield
    if constexpr (!Team::in_order) a_.row_of[p] = -1;
    if (!active) return;
    const int q = count_one(&env_.numbers().active);
    const Row row = rows_[q];
    row.pair() = p;
    if constexpr (!Team::in_order) a_.row_of[p] = q;
    const auto put = [&](int n, const Vec3<T>& from) {
      row[n] = from.x, row[n + 1] = from.y, row[n + 2] = from.z;
    };
    Vec3<T> before[4];
    pair.corners(a_.begin, before);
    put(Row::between, between);
    put(Row::before, combined(pair.near.weight, before));
    put(Row::normal, pair.normal);
    put(Row::tangential, pair.force.tangential);
    put(Row::force, multiply_add(pair.force.normal, pair.normal, pair.force.tangential));
    row[Row::normal_force] = pair.force.normal;
    row[Row::thickness] = pair.thickness;
    row[Row::friction] = pair.friction;
    for (int corner = 0; corner < 4; ++corner) {
      const int v = pair.vertex[corner];
      const T weight = pair.near.weight[corner];
      row.vertex(corner) = v;
      row[Row::weight + corner] = weight;
      row[Row::moves + corner] = c * weight * a_.inverse[v];
      if (take_first(a_.touched + v)) a_.moved[count_one(&env_.numbers().moved)] = v;
    }
  }

  PD_HD static Vec3<T> vector(const Row& row, int n) { return {row[n], row[n + 1], row[n + 2]}; }

  // How forces move the vertices; `first`: and S of every vertex.
  template <class Team>
  PD_HD void push(const Team& team, int active, int moved, bool first) const {
    const auto force_of = [](const Row& row) {
      return Four<T>{row[Row::force], row[Row::force + 1], row[Row::force + 2], T(0)};
    };
    const auto add = [&](const Row& row, const Four<T>& force, int corner, T& weight, Four<T>& by) {
      if (first) weight = weight + absolute(row[Row::weight + corner]);
      by = multiply_add(row[Row::moves + corner], force, by);
    };
    if constexpr (Team::in_order) {
      team.each(moved, [&](int n) {
        a_.moved_by[a_.moved[n]] = {T(0), T(0), T(0), T(0)};
        if (first) a_.weight[a_.moved[n]] = T(0);
      });
      team.each(active, [&](int q) {
        const Row row = rows_[q];
        const Four<T> force = force_of(row);
        PD_UNROLL
        for (int corner = 0; corner < 4; ++corner) {
          const int v = row.vertex(corner);
          add(row, force, corner, a_.weight[v], a_.moved_by[v]);
        }
      });
    } else {
      team.each(moved, [&](int n) {
        const int v = a_.moved[n], end = a_.start[v + 1];
        Four<T> by{T(0), T(0), T(0), T(0)};
        T weight(0);
        PD_UNROLL_4
        for (int entry = a_.start[v]; entry < end; ++entry) {
          const int corner = a_.corner[entry], q = a_.row_of[corner / 4];
          if (q >= 0) add(rows_[q], force_of(rows_[q]), corner % 4, weight, by);
        }
        a_.moved_by[v] = by;
        if (first) a_.weight[v] = weight;
      });
    }
  }

  template <class Lanes>
  PD_HD void advance(const Lanes& lanes, int& changes, bool first) const {
    using P = typename Lanes::Number;
    if (first) {
      lanes.each([&](int q) {
        const Row row = rows_[q];
        T sum(0);
        for (int corner = 0; corner < 4; ++corner)
          sum =
              multiply_add(absolute(row[Row::moves + corner]), a_.weight[row.vertex(corner)], sum);
        row[Row::beta] = T(1) / sum;
      });
    }
    const Row row = rows_[lanes.begin()];  // lanes lie side by side
    const auto load = [&](int n) { return lanes.load(row.place(n)); };
    const auto vector = [&](int n) { return Vec3<P>{load(n), load(n + 1), load(n + 2)}; };
    const auto store = [&](int n, const Vec3<P>& value) {
      lanes.store(row.place(n), value.x);
      lanes.store(row.place(n + 1), value.y);
      lanes.store(row.place(n + 2), value.z);
    };
    const Vec3<P> moved = lanes.vector([&](int q) {
      const Row own = rows_[q];
      const auto by = [&](int corner) { return a_.moved_by[own.vertex(corner)]; };
      Four<T> sum = multiply_add(own[Row::weight], by(0), Four<T>{T(0), T(0), T(0), T(0)});
      for (int corner = 1; corner < 4; ++corner)
        sum = multiply_add(own[Row::weight + corner], by(corner), sum);
      return sum;
    });
    const Vec3<P> normal = vector(Row::normal);
    const Multiplier<P> old{load(Row::normal_force), vector(Row::tangential)};
    const Multiplier<P> next =
        pd::advance(old, load(Row::beta), load(Row::thickness), load(Row::friction), normal,
                    vector(Row::between) + moved, vector(Row::before));
    lanes.store(row.place(Row::normal_force), next.normal);
    store(Row::tangential, next.tangential);
    store(Row::force, multiply_add(next.normal, normal, next.tangential));
    const auto same = [](const P& a, const P& b) { return a <= b && b <= a; };
    const Vec3<P>&was = old.tangential, &is = next.tangential;
    if (!lanes.all(same(old.normal, next.normal) && same(was.x, is.x) && same(was.y, is.y) &&
                   same(was.z, is.z)))
      changes = 1;
  }

  const Env& env_;
  const ContactArrays<T>& a_;
  const ActiveRows<T> rows_;
  const RigidColliders<T, HasRigid> rigid_;
};

}  // namespace pd::inline PD_TARGET
