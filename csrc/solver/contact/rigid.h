// Colliders with a mass: rigid bodies that move by inertia, weight, an applied wrench and the forces of pairs.
//
// With the centre of mass c, the turn u since the start of the step (Cayley's vector, along the axis by 2 tan(angle / 2)),
// W = m / h^2, the angular momentum h L of the free motion and its moment of inertia h^2 J (at the middle of the turn), the
// objective of a step has
//   E(c, u) = W / 2 |c - c_goal|^2 + u . J u / 2 - L . u.
// Its minimum is the free motion. At the present pose, a small shift t and turn w change it by
//   W / 2 |t|^2 + w . J w / 2 - W (c_goal - c) . t - torque . w,   torque = (1 + [u] / 2 + u u^T / 4) (L - J u).
// What balances the torque takes that momentum: L_next = L - torque.
// The prox of an iteration (solver/contact/prox.h) has t and w as six more unknowns, in this metric. So no momentum acts on
// a collider: it is where its inertia and the forces of its pairs leave it. Each sweep solves for t and w of all colliders
// first, with forces of pairs that follow them by beta, until they are still: then these forces balance their inertia. A
// pair of two colliders couples them: conjugate gradients solve Newton's steps of all at once, with the 6 x 6 matrices of
// each. Pairs then take the motion of their corners for given. A pair whose surfaces are near is active where the free
// motion would bring them too near.
#pragma once
#include "solver/contact/rigid_steps.h"
#include "solver/contact/rigid_turn.h"
#include "solver/report.h"

namespace pd::inline PD_TARGET {

// Newton's steps of a sweep: most take two. Four of eight are halves, as some cycle.
constexpr int rigid_passes = 32;
constexpr double rigid_near = 2;  // thicknesses within which the free motion makes pairs active

PD_HD Pose<double> widened(const Pose<float>& a) {
  return {widened<double>(a.origin), double(a.w), widened<double>(a.axis)};
}
PD_HD Pose<double> widened(const Pose<double>& a) { return a; }

// The pose after a shift of the `center`, a point of the body, and Cayley's turn about it.
template <class T>
PD_HD Pose<T> moved(const Pose<T>& from, const Vec3<double>& center, const Vec3<double>& shift,
                    const Vec3<double>& turn) {
  const Pose<double> old = widened(from);
  const Quaternion<double> q =
      Quaternion<double>{1.0, 0.5 * turn} * Quaternion<double>{old.w, old.axis};
  const double scale = 1.0 / square_root(multiply_add(q.w, q.w, dot(q.axis, q.axis)));
  const Pose<double> about{{0, 0, 0}, scale * q.w, scale * q.axis};
  const Vec3<double> origin = (old.place(center) + shift) - about.place(center);
  return {{T(origin.x), T(origin.y), T(origin.z)},
          T(about.w),
          {T(about.axis.x), T(about.axis.y), T(about.axis.z)}};
}

template <class T, bool MayExist>
class RigidColliders : public RigidSteps<T, MayExist> {
 public:
  using Steps = RigidSteps<T, MayExist>;
  using Steps::exist, Steps::is_rigid;
  using typename Steps::Env;
  using Row = ActiveRow<T>;

  PD_HD explicit RigidColliders(const Env& env) : Steps(env), rows_{env.a.first_rows, env.a.rows} {}

  PD_HD int count() const { return exist() ? plan_.colliders : 0; }

  // At the start of a step: their vertices do not move by hand.
  template <class Team>
  PD_HD void start(const Team& team) const {
    team.each(plan_.colliders, [&](int c) {
      const T* const n = env_.rigid + rigid_numbers * std::int64_t(c);
      const auto vector = [&](int at) {
        return Vec3<double>{double(n[at]), double(n[at + 1]), double(n[at + 2])};
      };
      RigidCollider& of = a_.rigid_collider[c];
      of.weight = n[0];
      of.center = vector(1);
      const Vec3<double> first = vector(4), last = vector(7);
      of.inertia = {{first, {first.y, last.x, last.y}, {first.z, last.y, last.z}}};
      of.momentum = vector(10);
    });
    each_vertex(team, [&](int v, int c) {
      a_.held[v] = 0;
      a_.inverse[v] = T(rigid_yield / a_.rigid_collider[c].weight);
      a_.component[v] = env_.body.components + c;
    });
  }

  PD_HD Pose<T> free_goal(int c) const { return Hand<T>::read(env_.goal_poses + 7 * c); }

  // Cayley's vector of the turn from the start of the step to a pose.
  PD_HD Vec3<double> turn_to(int c, const Pose<double>& pose) const {
    const Pose<double> begin = widened(Hand<T>::read(env_.poses + 7 * c));
    return turn_between<double>({begin.w, begin.axis}, {pose.w, pose.axis});
  }

  // The quadratics of a collider at a pose, as those of a body's vertices with these derivatives.
  PD_HD RigidBody body_at(int c, const Pose<T>& pose) const {
    const RigidCollider& of = a_.rigid_collider[c];
    const Pose<double> at = widened(pose);
    const Vec3<double> torque = torque_after(turn_to(c, at), of.inertia, of.momentum);
    const double half = 0.5 * trace(of.inertia);
    const Mat3<double> whole{{{half, 0, 0}, {0, half, 0}, {0, 0, half}}},
        twist = cross_matrix(0.5 * torque);
    RigidBody body;
    body.weight = of.weight;
    body.center = at.place(of.center);
    body.pull = of.weight * (widened(free_goal(c)).place(of.center) - body.center);
    body.second_moment = whole - of.inertia;
    for (int r = 0; r < 3; ++r) body.covariance.row[r] = body.second_moment.row[r] + twist.row[r];
    body.square = of.weight > 0 ? half / of.weight : 0.0;
    return body;
  }

  // E of all colliders at their poses.
  template <class Team>
  PD_HD double energy(const Team& team) const {
    team.each(plan_.colliders, [&](int c) {
      if (!is_rigid(c)) return;
      RigidCollider& of = a_.rigid_collider[c];
      const Pose<double> pose = widened(a_.hand[c].pose);
      const Vec3<double> way = pose.place(of.center) - widened(free_goal(c)).place(of.center),
                         turn = turn_to(c, pose);
      of.energy =
          0.5 * (of.weight * dot(way, way) + dot(turn, of.inertia * turn)) - dot(of.momentum, turn);
    });
    double sum = 0;
    for (int c = 0; c < plan_.colliders; ++c)
      if (is_rigid(c)) sum += a_.rigid_collider[c].energy;
    return sum;
  }

  // Before the sweeps of an iteration: the pairs of each collider, and its metric.
  template <class Team>
  PD_HD void begin(const Team& team, int active) const {
    const int pairs = env_.numbers().pairs;
    team.spread(pairs, [&](int p) { a_.joins[p] = 0; });
    team.each(plan_.colliders, [&](int c) {
      a_.side_start[c] = 0;
      if (is_rigid(c)) look(c);
    });
    team.each(active, [&](int q) {
      const Row row = rows_[q];
      T sum(0);
      for (int corner = 0; corner < 4; ++corner)
        sum = multiply_add(absolute(row[Row::moves + corner]), a_.weight[row.vertex(corner)], sum);
      row[Row::beta] = T(1) / sum;
      const int p = row.pair();
      for (int s = 0; s < 2; ++s) {
        const int c = side(a_.pair[p], s);
        a_.terms[p].arm[s] = {0, 0, 0};
        if (c < 0) continue;
        a_.terms[p].arm[s] = point(a_.pair[p], s) - a_.rigid_collider[c].at;
        a_.joins[p] = 1;
        count_one(a_.side_start + c);
      }
    });
    team.scan(a_.side_start, plan_.colliders);
    team.groups(plan_.colliders, [&](int c, const auto& group) {
      if (a_.side_start[c] == a_.side_start[c + 1]) return;
      group.select(
          pairs,
          [&](int p) {
            return a_.joins[p] && (side(a_.pair[p], 0) == c || side(a_.pair[p], 1) == c);
          },
          a_.side_pair + a_.side_start[c]);
    });
    team.barrier();
  }

  // Newton's steps of all colliders by the forces that follow them. Their corners move with them.
  template <class Team>
  PD_HD void move(const Team& team, int active, int moved, bool first) const {
    ContactNumbers& numbers = env_.numbers();
    carry(team, moved);
    bool goes = true;
    for (int pass = 0; goes && pass < rigid_passes; ++pass) {
      team.spread(1, [&](int) { numbers.changed = numbers.couples = 0; });
      team.barrier();
      team.each(active, [&](int q) {
        if (a_.joins[rows_[q].pair()]) find_terms(rows_[q], first && pass == 0);
      });
      team.groups(plan_.colliders, [&](int c, const auto& group) {
        if (!meets(c)) return;
        double sums[ContactSums::count] = {};
        each_of_side(group, c, sums, [&](const PairTerms& of, int s, auto& sum) {
          add_terms(sum, of.of_side(s, false));
        });
        if (group.leads()) linearise(a_.rigid_collider[c], sums);
      });
      if (numbers.couples) solve_jointly(team);
      team.each(plan_.colliders, [&](int c) {
        if (meets(c) && step(a_.rigid_collider[c], (pass & 4) != 0 ? 0.5 : 1.0))
          numbers.changed = 1;
      });
      goes = numbers.changed != 0;
      carry(team, moved);
    }
  }

  // After the sweeps: goals and targets, of colliders without a force the free motion.
  template <class Team>
  PD_HD void aim(const Team& team) const {
    const bool some = env_.numbers().active > 0;
    team.each(plan_.colliders, [&](int c) {
      if (!is_rigid(c)) return;
      const RigidCollider& of = a_.rigid_collider[c];
      a_.hand[c].goal = some && meets(c) ? pd::moved(a_.hand[c].pose, of.center, of.shift, of.turn)
                                         : free_goal(c);
    });
    each_vertex(team,
                [&](int v, int c) { a_.target[v] = a_.hand[c].goal.place(local_point(plan_, v)); });
  }

  // Of a pair that is near: whether free motions would bring it too near.
  PD_CALLED bool would_meet(const ContactPair<T>& pair) const {
    if (!(pair.near.distance < T(rigid_near) * pair.thickness)) return false;
    Vec3<T> corner[4];
    pair.corners(a_.target, corner);
    bool some = false;
    for (int n = 0; n < 4; ++n) {
      const int v = pair.vertex[n], c = plan_.collider[v];
      if (c < 0 || !is_rigid(c)) continue;
      some = true;
      corner[n] = a_.goal[v];
    }
    return some && !(pair.thickness <= dot(pair.normal, combined(pair.near.weight, corner)));
  }

  // At the end of a step: how far the forces on its vertices and its inertia would still move a collider [m].
  template <class Group>
  PD_CALLED double find_rest(int c, const Group& group) const {
    using S = ContactSums;
    RigidCollider& of = a_.rigid_collider[c];
    if (group.leads()) look(c);
    double wrench[6] = {};
    const Vec3<double> at = widened(a_.hand[c].pose).place(of.center);
    group.sum_range(
        a_.hand[c].begin, a_.hand[c].end,
        [&](int v, auto& sum) {
          const Vec3<double> force = widened<double>(env_.force_on(v)),
                             torque = cross(widened<double>(a_.place[v]) - at, force);
          sum[0] += force.x, sum[1] += force.y, sum[2] += force.z;
          sum[3] += torque.x, sum[4] += torque.y, sum[5] += torque.z;
        },
        wrench);
    if (!group.leads()) return 0.0;
    double sums[S::count] = {};
    for (int n = 0; n < 6; ++n) sums[S::force + n] = wrench[n];
    const Vec3<double> force{wrench[0], wrench[1], wrench[2]},
        torque{wrench[3], wrench[4], wrench[5]};
    const auto square = [&](const Vec3<double>& f, const Vec3<double>& t) {
      return dot(f, f) + of.length * of.length * dot(t, t);
    };
    const double turns = of.length * trace(of.inertia);
    of.unbalanced = square(of.pull + force, of.torque + torque);
    of.whole = square(of.pull, of.torque) + square(force, torque);
    of.rounding = of.weight * of.weight * dot(at, at) + turns * turns;
    linearise(of, sums);
    step(of, 1.0);
    return square_root(dot(of.shift, of.shift) + dot(of.turn, of.turn) / (of.length * of.length));
  }

  // After that: the share of the forces and torques on all colliders that is not balanced, as solver/report.h has that of
  // bodies. Torques count by the size.
  PD_HD double residual() const {
    double left = 0, whole = 0, rounding = 0;
    for (int c = 0; exist() && c < plan_.colliders; ++c) {
      if (!is_rigid(c)) continue;
      const RigidCollider& of = a_.rigid_collider[c];
      left += of.unbalanced, whole += of.whole, rounding += of.rounding;
    }
    const double more =
        square_root(left) - report_roundings * double(epsilon<T>()) * square_root(rounding);
    return more > 0 ? more / square_root(left > whole ? left : whole) : 0;
  }

  // Colliders stay where they are.
  template <class Team>
  PD_HD void stay(const Team& team) const {
    team.each(plan_.colliders, [&](int c) {
      if (is_rigid(c)) a_.hand[c].goal = a_.hand[c].pose;
    });
  }

 private:
  using Steps::env_, Steps::plan_, Steps::a_;
  using Steps::linearise, Steps::solve_jointly, Steps::step;
  using Steps::side, Steps::meets, Steps::each_of_side;

  // Its metric at the present pose.
  PD_HD void look(int c) const {
    RigidCollider& of = a_.rigid_collider[c];
    const RigidBody body = body_at(c, a_.hand[c].pose);
    of.at = body.center;
    of.length = body.square > 0 ? 1.0 / square_root(body.square) : 1.0;
    of.pull = body.pull;
    of.torque = axis_of(body.covariance);
    of.shift = of.turn = {0, 0, 0};
  }

  template <class Team, class Visit>
  PD_HD void each_vertex(const Team& team, const Visit& visit) const {
    team.each(plan_.vertices - plan_.body_vertices, [&](int n) {
      const int v = plan_.body_vertices + n, c = plan_.collider[v];
      if (is_rigid(c)) visit(v, c);
    });
  }

  // The closest point of a side.
  PD_HD Vec3<double> point(const ContactPair<T>& pair, int s) const {
    Vec3<double> sum = {0, 0, 0};
    for (int a = 0; a < 4; ++a) {
      if (pair.on_a(a) != (s == 0)) continue;
      const double share = s == 0 ? double(pair.near.weight[a]) : -double(pair.near.weight[a]);
      sum = multiply_add(share, widened<double>(a_.place[pair.vertex[a]]), sum);
    }
    return sum;
  }

  // Corners of active pairs move with their colliders.
  template <class Team>
  PD_HD void carry(const Team& team, int moved) const {
    team.each(moved, [&](int n) {
      const int v = a_.moved[n], c = plan_.collider[v];
      if (c < 0 || !is_rigid(c)) return;
      const RigidCollider& of = a_.rigid_collider[c];
      const Vec3<double> by = of.shift + cross(of.turn, widened<double>(a_.place[v]) - of.at);
      a_.moved_by[v] = {T(by.x), T(by.y), T(by.z), T(0)};
    });
  }

  // The force that a pair would have after a sweep by the radius of friction before it, and how it follows its corners.
  // `guess`: all pairs hold both ways, so that the first step does not go deep.
  PD_HD void find_terms(const Row& row, bool guess) const {
    const auto vector = [&](int n) { return Vec3<T>{row[n], row[n + 1], row[n + 2]}; };
    Vec3<T> between = vector(Row::between);
    for (int corner = 0; corner < 4; ++corner) {
      const Four<T> by = a_.moved_by[row.vertex(corner)];
      between = multiply_add(row[Row::weight + corner], Vec3<T>{by.x, by.y, by.z}, between);
    }
    const T beta = row[Row::beta], friction = row[Row::friction];
    const Vec3<T> normal = vector(Row::normal), before = vector(Row::before);
    const Multiplier<T> old{row[Row::normal_force], vector(Row::tangential)},
        next = pd::advance(old, beta, row[Row::thickness], T(0), normal, between, before);
    const Vec3<T> pull = tangential(
        subtract_product(old.tangential, beta, tangential(between - before, normal)), normal);
    const T size = square_root(dot(pull, pull)), bound = friction * old.normal;
    const int p = row.pair();
    PairTerms& terms = a_.terms[p];
    terms.before = terms.after = terms.lag = terms.radius = 0;
    terms.normal = widened<double>(normal);
    const T held = guess
                       ? multiply_add(beta, row[Row::thickness] - dot(normal, between), old.normal)
                       : next.normal;
    terms.force = widened<double>(multiply_add(held, normal, onto_disc(pull, bound)));
    terms.along = guess || next.normal > T(0) ? double(beta) : 0.0;
    terms.across = bound > T(0) ? double(beta) * (size > bound ? double(bound / size) : 1.0) : 0.0;
    const int c = side(a_.pair[p], 0), d = side(a_.pair[p], 1);
    terms.other[0] = d, terms.other[1] = c;
    if (c >= 0 && d >= 0 && terms.resists()) env_.numbers().couples = 1;
  }

  const ActiveRows<T> rows_;
};

}  // namespace pd::inline PD_TARGET
