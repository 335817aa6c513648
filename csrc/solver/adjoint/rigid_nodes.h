// Colliders with a mass in the adjoint of a step; solver/contact/rigid.h has their energy E.
//
// A collider that leaves its free motion has two nodes: the shift t of its centre of mass, and z = s w, its size s times
// its turn w. With r from the centre to a corner, and the force F = -w f of a pair there, these six numbers satisfy
//
//   W (c - c_goal) + sum F = 0,   (-torque + sum r x F) / s = 0,   s^2 = tr J / (2 W).
//
// A corner moves by t + z x r / s. No moment of inertia exceeds s^2 W, so 1 / W is 1 / D of both nodes. The derivative of
// the second row by z is, beside that of the forces,
//
//   -(d torque / d w) / s^2 + sum (r F^T - r . F) / s^2.
#pragma once
#include "contact/views.h"
#include "math/dual.h"
#include "solver/contact/rigid_turn.h"

namespace pd::inline PD_TARGET {

// What the row of a collider and its poses say, each a number that a gradient may be asked by.
template <class R>
struct RigidNumbers {
  R row[rigid_numbers], goal[7], begin[7];

  PD_HD static Vec3<R> vector(const R* at) { return {at[0], at[1], at[2]}; }
  PD_HD static Pose<R> pose(const R* at) { return {vector(at), at[3], vector(at + 4)}; }
  PD_HD static Quaternion<R> turn(const R* at) { return {at[3], vector(at + 4)}; }

  PD_HD const R& weight() const { return row[0]; }
  PD_HD Vec3<R> center() const { return vector(row + 1); }
  PD_HD Mat3<R> inertia() const {
    const R* const j = row + 4;
    return {{{j[0], j[1], j[2]}, {j[1], j[3], j[4]}, {j[2], j[4], j[5]}}};
  }
  PD_HD Vec3<R> momentum() const { return vector(row + 10); }
  PD_HD Vec3<R> torque(const Quaternion<R>& end) const {
    return torque_after(turn_between(turn(begin), end), inertia(), momentum());
  }
};
constexpr int rigid_inputs = rigid_numbers + 14;

// One collider with a mass, at its pose after the step.
struct RigidNode {
  RigidNumbers<double> at;
  Pose<double> end;
  double size;
  Vec3<double> center;              // of mass
  Mat3<double> inertia, stiffness;  // J / s^2; the derivative of the second row by z

  template <class T>
  PD_CALLED void set(const T* row, const T* begin, const T* after, const T* goal) {
    for (int n = 0; n < rigid_numbers; ++n) at.row[n] = double(row[n]);
    double pose[7];
    for (int n = 0; n < 7; ++n) {
      at.begin[n] = double(begin[n]);
      at.goal[n] = double(goal[n]);
      pose[n] = double(after[n]);
    }
    end = RigidNumbers<double>::pose(pose);
    center = end.place(at.center());
    const Mat3<double> moments = at.inertia();
    const double square =
        0.5 * (moments.row[0].x + moments.row[1].y + moments.row[2].z) / at.weight();
    size = square_root(square);
    inertia = (1 / square) * moments;
    Vec3<double> column[3];
    for (int j = 0; j < 3; ++j) column[j] = (-1 / square) * torque_by_turn(j);
    stiffness = {{{column[0].x, column[1].x, column[2].x},
                  {column[0].y, column[1].y, column[2].y},
                  {column[0].z, column[1].z, column[2].z}}};
  }

  // Adds a force at r / s from the centre.
  PD_HD void push(const Vec3<double>& arm, const Vec3<double>& force) {
    const Vec3<double> by = (1 / size) * force;
    const double along = dot(arm, by);
    stiffness.row[0] = stiffness.row[0] + arm.x * by - Vec3<double>{along, 0, 0};
    stiffness.row[1] = stiffness.row[1] + arm.y * by - Vec3<double>{0, along, 0};
    stiffness.row[2] = stiffness.row[2] + arm.z * by - Vec3<double>{0, 0, along};
  }

  // -l . dr / dp for input p, in the order of RigidNumbers, with the multipliers of both nodes.
  PD_CALLED double gradient(int input, const Vec3<double>& shift, const Vec3<double>& z) const {
    using D = Dual<double>;
    RigidNumbers<D> own;
    const auto vary = [&](D* to, const double* from, int count, int first) {
      for (int n = 0; n < count; ++n) to[n] = D(from[n], first + n == input ? 1.0 : 0.0);
    };
    vary(own.row, at.row, rigid_numbers, 0);
    vary(own.goal, at.goal, 7, rigid_numbers);
    vary(own.begin, at.begin, 7, rigid_numbers + 7);
    const Pose<D> now{still(end.origin), D(end.w), still(end.axis)};
    const Vec3<D> place = now.place(own.center()),
                  way = place - RigidNumbers<D>::pose(own.goal).place(own.center()),
                  turn = still((1 / size) * z);
    // the pose is that of the origin: another centre of mass has other arms, and W (c - c_goal) balances the forces
    const Vec3<D> load = still(at.weight() * Vec3<double>{way.x.value, way.y.value, way.z.value});
    const D work = own.weight() * dot(still(shift), way) + dot(turn, cross(place, load)) -
                   dot(turn, own.torque({now.w, now.axis}));
    return -work.slope;
  }

 private:
  PD_HD static Vec3<Dual<double>> still(const Vec3<double>& a) { return {a.x, a.y, a.z}; }

  PD_HD Vec3<double> torque_by_turn(int j) const {
    using D = Dual<double>;
    RigidNumbers<D> own;
    for (int n = 0; n < rigid_numbers; ++n) own.row[n] = D(at.row[n]);
    for (int n = 0; n < 7; ++n) own.begin[n] = own.goal[n] = D(at.begin[n]);
    const Quaternion<D> by{
        D(1.0),
        {D(0.0, j == 0 ? 0.5 : 0.0), D(0.0, j == 1 ? 0.5 : 0.0), D(0.0, j == 2 ? 0.5 : 0.0)}};
    const Vec3<D> torque = own.torque(by * Quaternion<D>{D(end.w), still(end.axis)});
    return {torque.x.slope, torque.y.slope, torque.z.slope};
  }
};

}  // namespace pd::inline PD_TARGET
