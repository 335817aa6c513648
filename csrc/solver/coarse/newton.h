// The rigid motion of a body with the least energy Phi: its quadratics (solver/coarse/sums.h) and the envelopes of its contacts
// (solver/coarse/envelope.h).
//
// Each finite motion ends at the least Phi with gaps and slips to first order in a twist, which is convex: Newton's steps, each
// ended where Phi is least along it. After one that is small beside the motion, radii of friction become friction times l. The
// motion is halved until Phi itself has not risen. A pass takes the contact sums of one trial. Vertices are moved once, at the end.
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

constexpr int most_motions = 6, most_steps = 12, most_cuts = 8, most_searches = 30;
// Of the size of a body, and of the radii: a motion that ends the passes, and a lag that is none.
constexpr double still_share = 1e-6;
// Of a motion: a step after which radii are renewed. Of these: a lag that ends the steps.
constexpr double settled_share = 0.1;
// Of the energy that moves a body by its size: a rise that is rounding.
constexpr double energy_rounding = 1e-14;
// Of the size of a body: how far a search along a step moves at its end.
constexpr double exact_share = 1e-9;
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
  return a.row[0].x > 0 &&
         difference_of_products(a.row[0].x, a.row[1].y, a.row[0].y, a.row[1].x) > 0 &&
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
    return {accepted_.turn, trial_.turn,         body_.center,       accepted_.shift,
            trial_.shift,   finite_ ? 1.0 : 0.0, renews_ ? 1.0 : 0.0};
  }

  // All passes of a body without contacts.
  PD_HD void move_free() {
    const double none[ContactSums::count] = {};
    while (!done_) pass(none);
  }

  PD_COLD void pass(const double (&sum)[ContactSums::count]) {
    if (finite_) {
      end_motion(sum);
    } else if (renews_) {
      renews_ = false;
      next_step(sum);
    } else {
      go_on(sum);
    }
  }

 private:
  // Of the quadratics, relative to no motion.
  PD_HD double energy(const RigidMotion<double>& motion) const {
    return 0.5 * body_.weight * dot(motion.shift, motion.shift) - dot(motion.shift, body_.pull) -
           frobenius(motion.turn, body_.covariance);
  }

  // After the pass of a finite motion: accepts it, or halves its twist.
  PD_HD void end_motion(const double (&sum)[ContactSums::count]) {
    using S = ContactSums;
    const double before = energy(accepted_) + sum[S::before],
                 after = energy(trial_) + sum[S::after];
    if (!(after <= before + energy_rounding * (body_.weight * body_.square + sum[S::before]))) {
      done_ = ++cuts_ > most_cuts;
      for (double& number : twist_) number *= 0.5;
      if (!done_) try_motion();
      return;
    }
    accepted_ = trial_;
    contact_energy_ = sum[S::after];
    cuts_ = 0;
    done_ = (motions_ > 0 && length_of(twist_) <= still_share * size_) || ++motions_ > most_motions;
    if (done_) return;
    find_quadratics();
    for (double& number : twist_) number = 0;
    steps_ = 0;
    finite_ = false;
    begin_step(sum);
  }

  // After a pass to first order: ends the step, or goes on to where Phi is least along it.
  PD_HD void go_on(const double (&sum)[ContactSums::count]) {
    using S = ContactSums;
    double at[6], force[6], matrix[21], slope = 0, second = 0;
    for (int i = 0; i < 6; ++i) at[i] = multiply_add(share_, step_[i], twist_[i]);
    find_terms(at, sum, force, matrix);
    for (int i = 0; i < 6; ++i) {
      slope -= force[i] * step_[i];
      for (int j = 0; j <= i; ++j)
        second += (i == j ? 1.0 : 2.0) * step_[i] * step_[j] * matrix[i * (i + 1) / 2 + j];
    }
    // the slope rises: Newton's step within the bracket, or its middle
    (slope < 0 ? low_ : high_) = share_;
    double next = share_ - slope / second;
    if (!(low_ < next && next < high_)) next = 0.5 * (low_ + high_);
    const bool ends = (share_ == 1.0 && !(slope > 0)) ||
                      absolute(next - share_) * length_of(step_) <= exact_share * size_;
    if (!ends && ++searches_ <= most_searches) {
      share_ = next;
      return try_step();
    }
    for (int i = 0; i < 6; ++i) twist_[i] = at[i];
    ++steps_;
    const double lag = sum[S::lag], radius = sum[S::radius];
    const double least = still_share * size_, share = settled_share * length_of(twist_);
    const double small = least > share ? least : share;
    const bool near = way_ <= small;
    ends_ = (near && lag <= settled_share * settled_share * radius) || steps_ >= most_steps;
    renews_ = near && lag > still_share * still_share * radius;
    if (!renews_) next_step(sum);
  }

  PD_HD void next_step(const double (&sum)[ContactSums::count]) {
    ends_ ? try_motion() : begin_step(sum);
  }

  PD_HD void begin_step(const double (&sum)[ContactSums::count]) {
    double matrix[21], force[6];
    find_terms(twist_, sum, force, matrix);
    for (int i = 0; i < 6; ++i) step_[i] = force[i];
    solve_6x6(matrix, step_);
    searches_ = 0;
    low_ = 0, high_ = share_ = 1;
    try_step();
  }

  PD_HD static double length_of(const double (&twist)[6]) {
    return square_root(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2]) +
           square_root(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5]);
  }

  // The trial to first order: the twist and the step.
  PD_HD void try_step() {
    way_ = share_ * length_of(step_);
    double at[6];
    for (int i = 0; i < 6; ++i) at[i] = multiply_add(share_, step_[i], twist_[i]);
    const Vec3<double> shift = {at[0], at[1], at[2]}, turn = {at[3], at[4], at[5]};
    const Mat3<double> more = cross_matrix(length_ * turn), product = more * accepted_.turn;
    trial_.shift = accepted_.shift + shift;
    for (int r = 0; r < 3; ++r)
      trial_.turn.row[r] = (accepted_.turn.row[r] + more.row[r]) + product.row[r];
  }

  // The finite trial.
  PD_HD void try_motion() {
    finite_ = true;
    const Vec3<double> shift = {twist_[0], twist_[1], twist_[2]},
                       turn = {twist_[3], twist_[4], twist_[5]};
    const Mat3<double> more = small_turn(length_ * turn), product = more * accepted_.turn;
    trial_.shift = accepted_.shift + shift;
    for (int r = 0; r < 3; ++r)
      trial_.turn.row[r] = (accepted_.turn.row[r] + more.row[r]) + product.row[r];
  }

  // R A
  PD_HD static Mat3<double> turned(const RigidMotion<double>& motion, const Mat3<double>& a) {
    Mat3<double> product = motion.turn * a;
    for (int r = 0; r < 3; ++r) product.row[r] = product.row[r] + a.row[r];
    return product;
  }

  // Of the quadratics at the accepted motion: minus the first derivative, and the second. In lengths: turns times the size.
  PD_HD void find_quadratics() {
    // sum a (r + d) r^T and sum a r r^T, with the arms and ways of now
    const Mat3<double> covariance = transpose(turned(accepted_, transpose(body_.covariance)));
    second_ = axis_matrix(covariance);
    if (!is_positive(second_)) {
      const Mat3<double> half = turned(accepted_, body_.second_moment);
      second_ = axis_matrix(transpose(turned(accepted_, transpose(half))));
    }
    second_ = (length_ * length_) * second_;
    force_ = subtract_product(body_.pull, body_.weight, accepted_.shift);
    moment_ = length_ * axis_of(covariance);
  }

  // Minus the first derivative of Phi to first order at a twist, and the second, by its lower triangle.
  PD_HD void find_terms(const double (&at)[6], const double (&sum)[ContactSums::count],
                        double (&force)[6], double (&matrix)[21]) const {
    using S = ContactSums;
    const Vec3<double> shift = {at[0], at[1], at[2]}, turn = {at[3], at[4], at[5]};
    const Vec3<double> f = subtract_product(force_, body_.weight, shift),
                       m = moment_ - second_ * turn;
    const double own[6] = {f.x, f.y, f.z, m.x, m.y, m.z};
    const double rows[3][3] = {{second_.row[0].x, second_.row[0].y, second_.row[0].z},
                               {second_.row[1].x, second_.row[1].y, second_.row[1].z},
                               {second_.row[2].x, second_.row[2].y, second_.row[2].z}};
    for (int i = 0; i < 6; ++i) {
      const double scale = i < 3 ? 1.0 : length_;
      force[i] = multiply_add(scale, sum[S::force + i], own[i]);
      for (int j = 0; j <= i; ++j)
        matrix[i * (i + 1) / 2 + j] =
            multiply_add(scale * (j < 3 ? 1.0 : length_), sum[S::at(i, j)],
                         i < 3   ? (i == j ? body_.weight : 0.0)
                         : j < 3 ? 0.0
                                 : rows[i - 3][j - 3]);
    }
    if (body_.hold != Hold::none) keep_to_pins(matrix, force);
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
      for (int j = 0; j < 3; ++j)
        along += n[i] * n[j] * (i > j ? entry(3 + i, 3 + j) : entry(3 + j, 3 + i));
    }
    for (int i = 0; i < 3; ++i) {
      step[3 + i] = force * n[i];
      for (int j = 0; j <= i; ++j) entry(3 + i, 3 + j) = along * ((i == j ? 1.0 : 0.0));
    }
  }

  RigidBody body_;
  RigidMotion<double> accepted_, trial_;
  Mat3<double> second_;
  Vec3<double> force_, moment_;
  double size_, length_;  // length_: 1 / size_
  double twist_[6] = {}, step_[6], share_ = 1, low_ = 0, high_ = 1;
  double way_ = 0, contact_energy_ = 0;
  int motions_ = 0, steps_ = 0, searches_ = 0, cuts_ = 0;
  bool finite_ = true, ends_ = false, renews_ = false, done_ = true;
};

// One of the two first iterates of a step, at a vertex: its displacement before and after the correction, and the motion of
// its body.
template <class W>
struct Candidate {
  Vec3<W> first, last;
  RigidMotion<W> motion;
};

// What a vertex adds to the rise of energy from the corrected present shape, `kept`, to the corrected guess, `moved`; besides
// the rise of Phi, and the work of the mean elastic force and the anchors' energies, which are known before. Inertia before
// the corrections, which Phi lacks; and the work of the pushes on the inertia that the anchors do not answer: all of it where
// they are those of elastic forces alone, else what the correction has changed.
template <bool HasContacts, class W>
PD_HD W rise_of(const W& inertia, const Vec3<W>& x, const Vec3<W>& target, const Candidate<W>& kept,
                const Candidate<W>& moved) {
  const Vec3<W> before = kept.first - target, after = moved.first - target;
  W rise = W(0.5) * (dot(after, after) - dot(before, before));
  if constexpr (HasContacts) {
    const auto work = [&](const Candidate<W>& of, const Vec3<W>& answered) {
      const Vec3<W> u = of.first + of.motion.of(x + of.first);
      return dot(u - answered, of.last - u);
    };
    rise = rise + (work(moved, moved.first) - work(kept, target));
  }
  return inertia * rise;
}

}  // namespace pd::inline PD_TARGET
