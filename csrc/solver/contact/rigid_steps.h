// Newton's steps of colliders with a mass: each alone, or those coupled by pairs of two colliders at once.
#pragma once
#include "solver/contact/environment.h"

namespace pd::inline PD_TARGET {

constexpr double joint_tolerance = 1e-8;  // of what a step of coupled colliders leaves
constexpr int joint_rounds = 64;

// `MayExist`: without it their code is left out.
template <class T, bool MayExist>
class RigidSteps {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit RigidSteps(const Env& env) : env_(env), plan_(env.plan), a_(env.a) {}

  PD_HD bool exist() const { return MayExist && plan_.rigid != nullptr; }
  PD_HD bool is_rigid(int c) const { return exist() && a_.rigid_collider[c].weight > 0; }

  // Whether it has pairs that are active.
  PD_HD bool meets(int c) const { return a_.side_start[c] < a_.side_start[c + 1]; }

  // Sums over its active pairs: add(terms, side, sum).
  template <int Count, class Group, class Add>
  PD_HD void each_of_side(const Group& group, int c, double (&sums)[Count], const Add& add) const {
    group.sum_range(
        a_.side_start[c], a_.side_start[c + 1],
        [&](int n, auto& sum) {
          const int p = a_.side_pair[n];
          add(a_.terms[p], side(a_.pair[p], 0) == c ? 0 : 1, sum);
        },
        sums);
  }

  // -1: no collider with a mass
  PD_HD int side(const ContactPair<T>& pair, int s) const {
    const int c = plan_.collider[pair.vertex[s == 0 ? 0 : 3]];
    return c >= 0 && is_rigid(c) ? c : -1;
  }

  // Its matrix and what it lacks to balance, turns in lengths, and its step alone.
  PD_HD void linearise(RigidCollider& of, const double (&sum)[ContactSums::count]) const {
    using S = ContactSums;
    const Vec3<double> force = subtract_product(of.pull, of.weight, of.shift),
                       torque = of.torque - of.inertia * of.turn;
    const double own[6] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
    const Mat3<double>& j = of.inertia;
    const double turns[6] = {j.row[0].x, j.row[1].x, j.row[1].y,
                             j.row[2].x, j.row[2].y, j.row[2].z};
    for (int r = 0; r < 6; ++r) {
      const double scale = r < 3 ? 1.0 : of.length;
      of.left[r] = scale * (own[r] + sum[S::force + r]);
      for (int c = 0; c <= r; ++c) {
        const double inertia = r < 3   ? (r == c ? of.weight : 0.0)
                               : c < 3 ? 0.0
                                       : turns[(r - 3) * (r - 2) / 2 + c - 3];
        of.matrix[r * (r + 1) / 2 + c] =
            scale * (c < 3 ? 1.0 : of.length) * (inertia + sum[S::at(r, c)]);
      }
    }
    solve_alone(of, of.way);
  }

  // The step of all colliders, by conjugate gradients from their steps alone.
  template <class Team>
  PD_HD void solve_jointly(const Team& team) const {
    ContactNumbers& numbers = env_.numbers();
    team.once([&] {
      double slope = 0;
      each_meeting([&](RigidCollider& of) {
        for (int n = 0; n < 6; ++n) {
          slope = multiply_add(of.left[n], of.way[n], slope);
          of.direction[n] = of.way[n];
          of.way[n] = 0;
        }
      });
      numbers.slope = slope;
      numbers.least_slope = joint_tolerance * joint_tolerance * slope;
    });
    for (int round = 0; round < joint_rounds && numbers.slope > numbers.least_slope; ++round) {
      team.groups(plan_.colliders, [&](int c, const auto& group) {
        if (!meets(c)) return;
        double sums[6] = {};
        each_of_side(group, c, sums, [&](const PairTerms& of, int s, auto& sum) {
          if (of.other[s] >= 0) add_coupling(of, s, sum);
        });
        if (group.leads()) multiply(a_.rigid_collider[c], sums);
      });
      team.once([&] { advance(numbers); });
    }
  }

  // A share of its step toward the balance of inertia and forces. Returns whether it moves.
  PD_HD bool step(RigidCollider& of, double share) const {
    const double (&way)[6] = of.way;
    const Vec3<double> shift{way[0], way[1], way[2]}, turn{way[3], way[4], way[5]};
    of.shift = multiply_add(share, shift, of.shift);
    of.turn = multiply_add(share * of.length, turn, of.turn);
    // places are no finer than their rounding
    constexpr double still = sizeof(T) == 4 ? 1e-6 : 1e-10, fine = epsilon<T>();
    const double arm = 1.0 / (of.length * of.length),
                 size = dot(of.shift, of.shift) + arm * dot(of.turn, of.turn),
                 least = still * still * size + fine * fine * (dot(of.at, of.at) + arm);
    return dot(shift, shift) + dot(turn, turn) > least;
  }

 private:
  PD_HD static void solve_alone(const RigidCollider& of, double (&way)[6]) {
    double terms[27];
    for (int n = 0; n < 21; ++n) terms[n] = of.matrix[n];
    for (int n = 0; n < 6; ++n) terms[21 + n] = of.left[n];
    solve_twist(terms, way);
  }

  template <class Visit>
  PD_HD void each_meeting(const Visit& visit) const {
    for (int c = 0; c < plan_.colliders; ++c)
      if (meets(c)) visit(a_.rigid_collider[c]);
  }

  // The force on one side, and its torque, that follows the direction of the collider of the other.
  PD_HD void add_coupling(const PairTerms& of, int s, double (&sum)[6]) const {
    const RigidCollider& other = a_.rigid_collider[of.other[s]];
    const double* const d = other.direction;
    const Vec3<double> turn = other.length * Vec3<double>{d[3], d[4], d[5]},
                       moved = Vec3<double>{d[0], d[1], d[2]} + cross(turn, of.arm[1 - s]);
    const Vec3<double> force = multiply_add((of.along - of.across) * dot(of.normal, moved),
                                            of.normal, of.across * moved),
                       torque = cross(of.arm[s], force);
    sum[0] += force.x, sum[1] += force.y, sum[2] += force.z;
    sum[3] += torque.x, sum[4] += torque.y, sum[5] += torque.z;
  }

  // The product of the whole matrix and the direction.
  PD_HD static void multiply(RigidCollider& of, const double (&coupling)[6]) {
    for (int r = 0; r < 6; ++r) {
      double sum = -(r < 3 ? 1.0 : of.length) * coupling[r];
      for (int c = 0; c < 6; ++c)
        sum = multiply_add(of.matrix[r > c ? r * (r + 1) / 2 + c : c * (c + 1) / 2 + r],
                           of.direction[c], sum);
      of.product[r] = sum;
    }
  }

  PD_HD void advance(ContactNumbers& numbers) const {
    double curvature = 0, slope = 0;
    each_meeting([&](RigidCollider& of) {
      for (int n = 0; n < 6; ++n)
        curvature = multiply_add(of.direction[n], of.product[n], curvature);
    });
    if (!(curvature > 0)) return void(numbers.slope = 0);
    const double length = numbers.slope / curvature;
    each_meeting([&](RigidCollider& of) {
      for (int n = 0; n < 6; ++n) {
        of.way[n] = multiply_add(length, of.direction[n], of.way[n]);
        of.left[n] = subtract_product(of.left[n], length, of.product[n]);
      }
      solve_alone(of, of.product);
      for (int n = 0; n < 6; ++n) slope = multiply_add(of.left[n], of.product[n], slope);
    });
    const double keep = slope / numbers.slope;
    each_meeting([&](RigidCollider& of) {
      for (int n = 0; n < 6; ++n)
        of.direction[n] = multiply_add(keep, of.direction[n], of.product[n]);
    });
    numbers.slope = slope;
  }

 protected:
  const Env& env_;
  const ContactPlan<T>& plan_;
  const ContactArrays<T>& a_;
};

}  // namespace pd::inline PD_TARGET
