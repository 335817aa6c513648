// The rigid motion of a body with the least energy Phi: its quadratics (solver/coarse/sums.h) and the envelopes of its contacts
// (solver/coarse/envelope.h).
//
// Each finite motion ends at the least Phi with gaps and slips to first order in a twist, which is convex: Newton's steps, each
// ended where Phi is least along it. Where the next one is small beside the motion, radii of friction go half way to friction
// times l, or all the way if they are near. The motion is halved until Phi itself has not risen. They end with a motion that is
// small. A pass takes the contact sums of one trial. Vertices are moved once, at the end.
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

constexpr int most_motions = 10, most_steps = 12, most_cuts = 8, most_searches = 30;
// Of the size of a body: a motion that ends the passes. Of the radii: how far behind friction l they may be left.
constexpr double still_share = 1e-7, lag_share = 1e-6;
// Of a motion: a next step with which it ends, once radii have followed. Of these: a lag that they make up at once.
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
  // Phi before the last small motion, the quadratics relative to no motion
  PD_HD double reached() const { return reached_; }

  // What the next pass asks for.
  PD_HD CoarseTrial<double> trial() const {
    return {accepted_.turn, trial_.turn,         body_.center, accepted_.shift,
            trial_.shift,   finite_ ? 1.0 : 0.0, renews_};
  }

  PD_CALLED void pass(const double (&sum)[ContactSums::count]) {
    if (finite_ && !accept(sum)) return;
    double terms[terms_count];
    find_terms(sum, terms);
    if (share_ > 0 && !ends_step(terms)) return try_step();
    for (int i = 0; i < 6; ++i) twist_[i] = multiply_add(share_, step_[i], twist_[i]);
    decide(terms, sum[ContactSums::lag], sum[ContactSums::radius]);
  }

 private:
  // A symmetric 6 x 6 matrix by its lower triangle, row by row, and as row 6 a right side.
  static constexpr int terms_count = 27;
  PD_HD static constexpr int at(int row, int column) { return row * (row + 1) / 2 + column; }

  // Of the quadratics, relative to no motion.
  PD_HD double energy(const RigidMotion<double>& motion) const {
    return 0.5 * body_.weight * dot(motion.shift, motion.shift) - dot(motion.shift, body_.pull) -
           frobenius(motion.turn, body_.covariance);
  }

  // After the pass of a finite motion: halves its twist, or accepts it, and whether the passes go on from there.
  PD_HD bool accept(const double (&sum)[ContactSums::count]) {
    using S = ContactSums;
    const double before = energy(accepted_) + sum[S::before],
                 after = energy(trial_) + sum[S::after];
    if (!(after <= before + energy_rounding * (body_.weight * body_.square + sum[S::before]))) {
      done_ = ++cuts_ > most_cuts;
      for (double& number : twist_) number *= 0.5;
      if (!done_) try_motion();
      return false;
    }
    accepted_ = trial_;
    reached_ = after;
    done_ = ++motions_ > most_motions;
    if (done_) return false;
    find_quadratics();
    for (double& number : twist_) number = 0;
    share_ = 0;
    steps_ = cuts_ = 0;
    return true;
  }

  // Whether Phi to first order is least here along the step; else how much of it to try next.
  PD_HD bool ends_step(const double (&terms)[terms_count]) {
    double slope = 0, second = 0;
    PD_UNROLL
    for (int r = 0; r < 6; ++r) {
      double product = 0;
      PD_UNROLL
      for (int c = 0; c < 6; ++c)
        product = multiply_add(terms[c < r ? at(r, c) : at(c, r)], step_[c], product);
      second = multiply_add(product, step_[r], second);
      slope = subtract_product(slope, terms[at(6, r)], step_[r]);
    }
    // the slope rises: Newton's step within the bracket, or its middle
    (slope < 0 ? low_ : high_) = share_;
    double next = share_ - slope / second;
    if (next != share_ && !(low_ < next && next < high_)) next = 0.5 * (low_ + high_);
    if ((share_ == 1.0 && !(slope > 0)) ||
        absolute(next - share_) * length_of(step_) <= exact_share * size_ ||
        ++searches_ > most_searches)
      return true;
    share_ = next;
    return false;
  }

  // From the terms at the twist: Newton's next step; where that is small, radii are renewed, or it ends the motion. A small
  // motion needs no pass, and is the last.
  PD_HD void decide(double (&terms)[terms_count], double lag, double radius) {
    const double moved = length_of(twist_), least = still_share * size_,
                 part = settled_share * moved;
    renews_ = 0;
    if (++steps_ <= most_steps) {
      solve(terms);
      searches_ = 0;
      low_ = 0, high_ = share_ = 1;
      if (length_of(step_) > (least > part ? least : part)) return try_step();
      if (lag > lag_share * lag_share * radius) {
        renews_ = lag <= settled_share * settled_share * radius ? 1.0 : 0.5;
        share_ = 0;  // a pass at the twist
        return try_step();
      }
      for (int i = 0; i < 6; ++i) twist_[i] += step_[i];
    }
    try_motion();
    done_ = length_of(twist_) <= least;
    if (done_) accepted_ = trial_;
  }

  PD_HD static double length_of(const double (&twist)[6]) {
    return square_root(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2]) +
           square_root(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5]);
  }

  // The trial to first order: the twist and the step.
  PD_HD void try_step() {
    finite_ = false;
    double at[6];
    for (int i = 0; i < 6; ++i) at[i] = multiply_add(share_, step_[i], twist_[i]);
    set_trial(at, cross_matrix(turn_of(at)));
  }

  // The finite trial.
  PD_HD void try_motion() {
    finite_ = true;
    set_trial(twist_, small_turn(turn_of(twist_)));
  }

  PD_HD Vec3<double> turn_of(const double (&twist)[6]) const {
    return length_ * Vec3<double>{twist[3], twist[4], twist[5]};
  }

  PD_HD void set_trial(const double (&twist)[6], const Mat3<double>& more) {
    const Mat3<double> product = more * accepted_.turn;
    trial_.shift = accepted_.shift + Vec3<double>{twist[0], twist[1], twist[2]};
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

  // Of Phi to first order at the twist and a share of the step: the second derivative, and minus the first.
  PD_HD void find_terms(const double (&sum)[ContactSums::count],
                        double (&terms)[terms_count]) const {
    double now[6];
    for (int i = 0; i < 6; ++i) now[i] = multiply_add(share_, step_[i], twist_[i]);
    const Vec3<double> shift = {now[0], now[1], now[2]}, turn = {now[3], now[4], now[5]};
    const Vec3<double> f = subtract_product(force_, body_.weight, shift),
                       m = moment_ - second_ * turn;
    const double force[6] = {f.x, f.y, f.z, m.x, m.y, m.z};
    const double turns[6] = {second_.row[0].x, second_.row[1].x, second_.row[1].y,
                             second_.row[2].x, second_.row[2].y, second_.row[2].z};
    PD_UNROLL
    for (int r = 0; r <= 6; ++r) {
      PD_UNROLL
      for (int c = 0; c <= r && c < 6; ++c) {
        const double own = r == 6  ? force[c]
                           : r < 3 ? (r == c ? body_.weight : 0.0)
                           : c < 3 ? 0.0
                                   : turns[at(r - 3, c - 3)];
        const double scale = (r < 3 || r == 6 ? 1.0 : length_) * (c < 3 ? 1.0 : length_);
        terms[at(r, c)] = multiply_add(scale, sum[ContactSums::matrix + at(r, c)], own);
      }
    }
    if (body_.hold != Hold::none) keep_to_pins(terms);
  }

  // Pins leave no shift; along a line they leave the turn about it.
  PD_HD void keep_to_pins(double (&terms)[terms_count]) const {
    const double axis[3] = {body_.axis.x, body_.axis.y, body_.axis.z};
    const bool line = body_.hold == Hold::line;
    double along = 0, force = 0;
    PD_UNROLL
    for (int r = 0; r < 3; ++r) {
      force = multiply_add(terms[at(6, 3 + r)], axis[r], force);
      PD_UNROLL
      for (int c = 0; c < 3; ++c)
        along = multiply_add(terms[c < r ? at(3 + r, 3 + c) : at(3 + c, 3 + r)], axis[r] * axis[c],
                             along);
    }
    PD_UNROLL
    for (int r = 0; r <= 6; ++r) {
      PD_UNROLL
      for (int c = 0; c <= r && c < 6; ++c) {
        double& term = terms[at(r, c)];
        if (c < 3) {
          term = 0;
        } else if (line) {
          term = r == 6 ? force * axis[c - 3] : r == c ? along : 0.0;
        }
      }
    }
  }

  // step = x with A x = b for an A that is not negative, 0 along rows without pivot: A = L D L^T. Terms are lost.
  PD_HD void solve(double (&a)[terms_count]) {
    double most = 0, inverse[6];
    PD_UNROLL
    for (int i = 0; i < 6; ++i) most = a[at(i, i)] > most ? a[at(i, i)] : most;
    PD_UNROLL
    for (int j = 0; j < 6; ++j) {
      const double pivot = a[at(j, j)];
      inverse[j] = pivot > no_pivot * most ? 1.0 / pivot : 0.0;
      PD_UNROLL
      for (int c = j + 1; c < 6; ++c) {
        const double factor = inverse[j] * a[at(c, j)];
        PD_UNROLL
        for (int r = c; r <= 6; ++r)
          a[at(r, c)] = subtract_product(a[at(r, c)], factor, a[at(r, j)]);
      }
    }
    PD_UNROLL
    for (int j = 5; j >= 0; --j) {
      step_[j] = inverse[j] * a[at(6, j)];
      PD_UNROLL
      for (int c = 0; c < j; ++c)
        a[at(6, c)] = subtract_product(a[at(6, c)], a[at(j, c)], step_[j]);
    }
  }

  RigidBody body_;
  RigidMotion<double> accepted_, trial_;
  Mat3<double> second_;
  Vec3<double> force_, moment_;
  double size_, length_;  // length_: 1 / size_
  double twist_[6] = {}, step_[6] = {}, share_ = 0, low_ = 0, high_ = 1;
  double reached_ = 0;
  int motions_ = 0, steps_ = 0, searches_ = 0, cuts_ = 0;
  double renews_ = 0;  // share by which the pass moves radii toward friction l
  bool finite_ = true, done_ = true;
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
