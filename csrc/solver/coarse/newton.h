// Newton's method for the rigid motion of a body with the least energy Phi: its quadratics (solver/coarse/sums.h) and the
// envelopes of its contacts (solver/coarse/envelope.h).
//
// A pass takes the contact sums of a trial. If Phi has not risen the trial is accepted, and the twist of Newton's step leads to
// the next one. Else the step ends where the quadratic model of Phi at the trial is least along it. Radii of friction move half way to friction times l in every pass that begins near
// enough. Finite motions are kept as a turn about the moving centre and a shift, so that vertices are moved once, at the end.
#pragma once
#include "solver/coarse/envelope.h"
#include "solver/coarse/sums.h"

namespace pd::inline PD_TARGET {

// y += turn (y - center) + shift
template <class T>
struct RigidMotion {
  Mat3<T> turn;  // R - I
  Vec3<T> center, shift;

  PD_HD Vec3<T> of(const Vec3<T>& y) const { return turn * (y - center) + shift; }
};

constexpr int most_passes = 32, most_cuts = 8;
// Shares of the size of a body, and of a radius: a motion that ends the passes, and one within which radii are renewed.
constexpr double still_share = 1e-6, near_share = 1e-3;
// Of the energy that moves a body by its size: a rise that is rounding.
constexpr double energy_rounding = 1e-14;
// Of the largest pivot: no inertia, such as that of a line about itself.
constexpr double no_pivot = 1e-12;

// By Cayley's formula: about an axis by 2 atan(|v| / 2), less the identity.
PD_HD Mat3<double> small_turn(const Vec3<double>& v) {
  const Mat3<double> half = cross_matrix(0.5 * v), square = half * half;
  const double share = 2.0 / (1.0 + 0.25 * dot(v, v));
  Mat3<double> turn = share * half;
  for (int r = 0; r < 3; ++r) turn.row[r] = multiply_add(share, square.row[r], turn.row[r]);
  return turn;
}

PD_HD bool is_positive(const Mat3<double>& a) {
  return a.row[0].x > 0 && difference_of_products(a.row[0].x, a.row[1].y, a.row[0].y, a.row[1].x) > 0 &&
         determinant(a) > 0;
}

// x with A x = b for a symmetric A that is not negative, by its lower triangle, row by row; 0 along rows without pivot.
PD_CALLED inline void solve_6x6(double (&a)[21], double (&b)[6]) {
  const auto at = [](int i, int j) { return i * (i + 1) / 2 + j; };
  double most = 0, inverse[6];
  for (int i = 0; i < 6; ++i) most = a[at(i, i)] > most ? a[at(i, i)] : most;
  // A = L D L^T
  for (int j = 0; j < 6; ++j) {
    const double pivot = a[at(j, j)];
    inverse[j] = pivot > no_pivot * most ? 1.0 / pivot : 0.0;
    for (int i = j + 1; i < 6; ++i) {
      const double factor = inverse[j] * a[at(i, j)];
      for (int k = i; k < 6; ++k) a[at(k, i)] = subtract_product(a[at(k, i)], factor, a[at(k, j)]);
      b[i] = subtract_product(b[i], factor, b[j]);
    }
  }
  for (int i = 5; i >= 0; --i) {
    double sum = b[i];
    for (int k = i + 1; k < 6; ++k) sum = subtract_product(sum, a[at(k, i)], b[k]);
    b[i] = inverse[i] * sum;
  }
}

// The passes of one body.
class CoarseBody {
 public:
  CoarseBody() = default;

  PD_HD explicit CoarseBody(const RigidBody& body) : body_(body) {
    size_ = square_root(body.square);
    length_ = size_ > 0 ? 1.0 / size_ : 1.0;
    accepted_ = trial_ = {{}, body.center, {0, 0, 0}};
    done_ = !moves();
  }

  PD_HD bool moves() const { return body_.weight > 0 && body_.hold != Hold::all; }
  PD_HD bool is_done() const { return done_; }
  PD_HD const RigidMotion<double>& motion() const { return accepted_; }
  // Phi there, the quadratics relative to no motion
  PD_HD double reached() const { return energy(accepted_) + contact_energy_; }

  // What the next pass asks for.
  PD_HD CoarseTrial<double> trial() const {
    return {accepted_.turn, trial_.turn, body_.center, accepted_.shift, trial_.shift, renews() ? 0.5 : 0.0};
  }

  // All passes of a body without contacts.
  PD_HD void move_free() {
    const double none[ContactSums::count] = {};
    while (!done_) pass(none);
  }

  PD_COLD void pass(const double (&sum)[ContactSums::count]) {
    using S = ContactSums;
    const double before = energy(accepted_) + sum[S::before], after = energy(trial_) + sum[S::after];
    const double rounding = energy_rounding * (body_.weight * body_.square + sum[S::before]);
    if (after <= before + rounding) {
      accepted_ = trial_;
      contact_energy_ = sum[S::after];
      cuts_ = 0;
      const bool settled = sum[S::lag] <= still_share * still_share * sum[S::radius];
      done_ = (passes_ > 0 && way_ <= still_share * size_ && settled) || ++passes_ > most_passes;
      if (!done_) find_step(sum);
    } else {
      done_ = ++cuts_ > most_cuts;
      shorten(sum);
    }
    if (!done_) take_step();
  }

 private:
  // Of the quadratics, relative to no motion.
  PD_HD double energy(const RigidMotion<double>& motion) const {
    return 0.5 * body_.weight * dot(motion.shift, motion.shift) - dot(motion.shift, body_.pull) -
           frobenius(motion.turn, body_.covariance);
  }

  // whether the trial is near enough to the last one
  PD_HD bool renews() const { return passes_ > 0 && way_ <= near_share * size_; }

  // R A
  PD_HD static Mat3<double> turned(const RigidMotion<double>& motion, const Mat3<double>& a) {
    Mat3<double> product = motion.turn * a;
    for (int r = 0; r < 3; ++r) product.row[r] = product.row[r] + a.row[r];
    return product;
  }

  // Minus the first derivative of Phi at a motion, and the second, by its lower triangle. In lengths: turns times the size.
  PD_HD void find_terms(const RigidMotion<double>& at, const double (&sum)[ContactSums::count],
                        double (&step)[6], double (&matrix)[21]) const {
    using S = ContactSums;
    // sum a (r + d) r^T and sum a r r^T, with the arms and ways of now
    const Mat3<double> covariance = transpose(turned(at, transpose(body_.covariance)));
    Mat3<double> second = axis_matrix(covariance);
    if (!is_positive(second)) {
      const Mat3<double> half = turned(at, body_.second_moment);
      second = axis_matrix(transpose(turned(at, transpose(half))));
    }
    const Vec3<double> force = subtract_product(body_.pull, body_.weight, at.shift),
                       moment = axis_of(covariance);
    const double own[6] = {force.x, force.y, force.z, moment.x, moment.y, moment.z};
    for (int n = 0; n < 21; ++n) matrix[n] = sum[S::matrix + n];
    const double rows[3][3] = {{second.row[0].x, second.row[0].y, second.row[0].z},
                               {second.row[1].x, second.row[1].y, second.row[1].z},
                               {second.row[2].x, second.row[2].y, second.row[2].z}};
    for (int i = 0; i < 6; ++i) {
      const double scale = i < 3 ? 1.0 : length_;
      step[i] = scale * (own[i] + sum[S::force + i]);
      for (int j = 0; j <= i; ++j) {
        double& number = matrix[S::at(i, j) - S::matrix];
        number += i < 3 ? (i == j ? body_.weight : 0.0) : j < 3 ? 0.0 : rows[i - 3][j - 3];
        number *= scale * (j < 3 ? 1.0 : length_);
      }
    }
    if (body_.hold != Hold::none) keep_to_pins(matrix, step);
  }

  PD_HD void find_step(const double (&sum)[ContactSums::count]) {
    double matrix[21];
    find_terms(accepted_, sum, step_, matrix);
    solve_6x6(matrix, step_);
  }

  // Ends the step where the quadratic model of Phi at the trial is least along it, or half way.
  PD_HD void shorten(const double (&sum)[ContactSums::count]) {
    double force[6], matrix[21], slope = 0, second = 0;
    find_terms(trial_, sum, force, matrix);
    for (int i = 0; i < 6; ++i) {
      slope -= force[i] * step_[i];
      for (int j = 0; j <= i; ++j)
        second += (i == j ? 1.0 : 2.0) * step_[i] * step_[j] * matrix[i * (i + 1) / 2 + j];
    }
    const double back = slope / second, share = back > 0 && back < 1 ? 1.0 - back : 0.5;
    for (double& number : step_) number *= share;
  }

  // Pins leave no shift; along a line they leave the turn about it.
  PD_HD void keep_to_pins(double (&matrix)[21], double (&step)[6]) const {
    const auto entry = [&](int i, int j) -> double& { return matrix[i * (i + 1) / 2 + j]; };
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < 3 && j <= i; ++j) entry(i, j) = 0;
      if (i < 3) step[i] = 0;
    }
    if (body_.hold != Hold::line) return;
    const double n[3] = {body_.axis.x, body_.axis.y, body_.axis.z};
    double along = 0, force = 0;
    for (int i = 0; i < 3; ++i) {
      force += n[i] * step[3 + i];
      for (int j = 0; j < 3; ++j) along += n[i] * n[j] * (i > j ? entry(3 + i, 3 + j) : entry(3 + j, 3 + i));
    }
    for (int i = 0; i < 3; ++i) {
      step[3 + i] = force * n[i];
      for (int j = 0; j <= i; ++j) entry(3 + i, 3 + j) = along * ((i == j ? 1.0 : 0.0));
    }
  }

  PD_HD void take_step() {
    const Vec3<double> shift = {step_[0], step_[1], step_[2]}, turn = {step_[3], step_[4], step_[5]};
    way_ = square_root(dot(shift, shift)) + square_root(dot(turn, turn));
    const Mat3<double> more = small_turn(length_ * turn), product = more * accepted_.turn;
    trial_.shift = accepted_.shift + shift;
    for (int r = 0; r < 3; ++r)
      trial_.turn.row[r] = (accepted_.turn.row[r] + more.row[r]) + product.row[r];
  }

  RigidBody body_;
  RigidMotion<double> accepted_, trial_;
  double size_, length_, step_[6], way_ = 0, contact_energy_ = 0;  // length_: 1 / size_
  int passes_ = 0, cuts_ = 0;
  bool done_ = true;
};

}  // namespace pd::inline PD_TARGET
