// The rigid motion of a body with the least energy Phi: its quadratics (solver/coarse/sums.h) and the envelopes of its contacts
// (solver/coarse/envelope.h).
//
// Newton's steps, each a finite motion, shortened where Phi rises or has turned upward. Where the next step is small beside
// the motion, radii of friction go half way to friction times l, or all the way if they are near. A pass takes the contact
// sums of one trial. The last step is small, and unchecked. Vertices are moved once, at the end.
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

constexpr int most_passes = 1024;
// Of the size of a body: a step that ends the passes. Of the radii: how far behind friction l they may be left.
constexpr double still_share = 1e-7, lag_share = 1e-6;
// Of the motion since radii moved: a step with which they move again. Of these: a lag that they make up at once.
constexpr double settled_share = 0.1;
// Of the slope of Phi at the start of a step: an upward one at its end.
constexpr double flat_share = 0.5;
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

// w of the turn of a motion by 2 atan(|w| / 2): Cayley's formula backward.
PD_HD Vec3<double> turn_vector(const RigidMotion<double>& motion) {
  return (2.0 / (4.0 + trace(motion.turn))) * axis_of(motion.turn);
}

PD_HD bool is_positive(const Mat3<double>& a) {
  return a.row[0].x > 0 &&
         difference_of_products(a.row[0].x, a.row[1].y, a.row[0].y, a.row[1].x) > 0 &&
         determinant(a) > 0;
}

// x with A x = b for an A that is not negative, 0 along rows without pivot: A = L D L^T. `a`: the lower triangle row by row,
// then b. It is lost.
PD_HD void solve_twist(double (&a)[27], double (&x)[6]) {
  const auto at = [](int row, int column) { return row * (row + 1) / 2 + column; };
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
      for (int r = c; r <= 6; ++r) a[at(r, c)] = subtract_product(a[at(r, c)], factor, a[at(r, j)]);
    }
  }
  PD_UNROLL
  for (int j = 5; j >= 0; --j) {
    x[j] = inverse[j] * a[at(6, j)];
    PD_UNROLL
    for (int c = 0; c < j; ++c) a[at(6, c)] = subtract_product(a[at(6, c)], a[at(j, c)], x[j]);
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
  PD_HD const RigidMotion<double>& next_motion() const { return trial_; }
  // Phi before the last step, the quadratics relative to no motion
  PD_HD double reached() const { return reached_; }

  // What the next pass asks for.
  PD_HD CoarseTrial<double> trial() const {
    return {accepted_.turn, trial_.turn, body_.center, accepted_.shift, trial_.shift, renews_};
  }

  PD_CALLED void pass(const double (&sum)[ContactSums::count]) {
    using S = ContactSums;
    done_ = ++passes_ > most_passes;
    if (done_) return;
    const double before = energy(accepted_) + sum[S::before],
                 after = energy(trial_) + sum[S::after];
    const double rounding = energy_rounding * (body_.weight * body_.square + sum[S::before]);
    double terms[terms_count];
    find_terms(sum, terms);
    if (share_ > 0 && !ends_step(terms, after <= before + rounding)) return try_step();
    accepted_ = trial_;
    reached_ = after;
    moved_ += share_ * length_of(step_);
    decide(terms, sum[S::lag], sum[S::radius]);
  }

 private:
  friend class CoarseIsland;  // steps of several bodies at once

  // A symmetric 6 x 6 matrix by its lower triangle, row by row, and as row 6 a right side.
  static constexpr int terms_count = 27;
  PD_HD static constexpr int at(int row, int column) { return row * (row + 1) / 2 + column; }

  // Of the quadratics, relative to no motion.
  PD_HD double energy(const RigidMotion<double>& motion) const {
    return 0.5 * body_.weight * dot(motion.shift, motion.shift) - dot(motion.shift, body_.pull) -
           frobenius(motion.turn, body_.covariance);
  }

  // Whether the trial is good enough; else how much of the step to try next.
  PD_HD bool ends_step(const double (&terms)[terms_count], bool falls) {
    // of the twist by the share, about the axis of the turn: Cayley's formula
    const Vec3<double> turn = share_ * turn_of(step_);
    const double rate = 1.0 / (1.0 + 0.25 * dot(turn, turn));
    double way[6], slope = 0, second = 0;
    for (int i = 0; i < 6; ++i) way[i] = (i < 3 ? 1.0 : rate) * step_[i];
    PD_UNROLL
    for (int r = 0; r < 6; ++r) {
      double product = 0;
      PD_UNROLL
      for (int c = 0; c < 6; ++c)
        product = multiply_add(terms[c < r ? at(r, c) : at(c, r)], way[c], product);
      second = multiply_add(product, way[r], second);
      slope = subtract_product(slope, terms[at(6, r)], way[r]);
    }
    if (falls && slope <= flat_share * slope_) return true;
    // Newton's step from here, or half of it
    const double next = share_ - slope / second;
    share_ = 0 < next && next < share_ ? next : 0.5 * share_;
    return false;
  }

  // From the terms at the accepted motion: Newton's step, or radii are renewed. A small step is the last.
  PD_HD void decide(double (&terms)[terms_count], double lag, double radius) {
    double force[6];
    for (int i = 0; i < 6; ++i) force[i] = terms[at(6, i)];
    solve_twist(terms, step_);
    slope_ = 0;
    for (int i = 0; i < 6; ++i) slope_ = multiply_add(force[i], step_[i], slope_);
    const double length = length_of(step_), least = still_share * size_;
    const bool behind = lag > lag_share * lag_share * radius;
    share_ = 1;
    renews_ = 0;
    if (behind && (length <= least || length <= settled_share * moved_)) {
      renews_ = lag <= settled_share * settled_share * radius ? 1.0 : 0.5;
      share_ = moved_ = 0;  // a pass at the accepted motion
    }
    try_step();
    done_ = !behind && length <= least;
    if (done_) accepted_ = trial_;
  }

  PD_HD static double length_of(const double (&twist)[6]) {
    return square_root(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2]) +
           square_root(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5]);
  }

  PD_HD void try_step() {
    const Mat3<double> more = small_turn(share_ * turn_of(step_)), product = more * accepted_.turn;
    trial_.shift =
        multiply_add(share_, Vec3<double>{step_[0], step_[1], step_[2]}, accepted_.shift);
    for (int r = 0; r < 3; ++r)
      trial_.turn.row[r] = (accepted_.turn.row[r] + more.row[r]) + product.row[r];
  }

  PD_HD Vec3<double> turn_of(const double (&twist)[6]) const {
    return length_ * Vec3<double>{twist[3], twist[4], twist[5]};
  }

  // R A
  PD_HD static Mat3<double> turned(const RigidMotion<double>& motion, const Mat3<double>& a) {
    Mat3<double> product = motion.turn * a;
    for (int r = 0; r < 3; ++r) product.row[r] = product.row[r] + a.row[r];
    return product;
  }

  // Of Phi at the trial, by a twist in lengths, turns times the size: the second derivative, and minus the first.
  PD_HD void find_terms(const double (&sum)[ContactSums::count],
                        double (&terms)[terms_count]) const {
    // sum a (r + d) r^T and sum a r r^T, with the arms and ways of now
    const Mat3<double> covariance = transpose(turned(trial_, transpose(body_.covariance)));
    Mat3<double> second = axis_matrix(covariance);
    if (!is_positive(second)) {
      const Mat3<double> half = turned(trial_, body_.second_moment);
      second = axis_matrix(transpose(turned(trial_, transpose(half))));
    }
    second = (length_ * length_) * second;
    const Vec3<double> f = subtract_product(body_.pull, body_.weight, trial_.shift),
                       m = length_ * axis_of(covariance);
    const double force[6] = {f.x, f.y, f.z, m.x, m.y, m.z};
    const double turns[6] = {second.row[0].x, second.row[1].x, second.row[1].y,
                             second.row[2].x, second.row[2].y, second.row[2].z};
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

  // Derivatives by a twist become those by a twist in lengths that pins leave.
  PD_HD void keep_twist(double (&line)[6]) const {
    for (int i = 3; i < 6; ++i) line[i] *= length_;
    if (body_.hold == Hold::none) return;
    const double axis[3] = {body_.axis.x, body_.axis.y, body_.axis.z};
    const double along = line[3] * axis[0] + line[4] * axis[1] + line[5] * axis[2];
    for (int i = 0; i < 3; ++i) {
      line[i] = 0;
      if (body_.hold == Hold::line) line[3 + i] = along * axis[i];
    }
  }

  RigidBody body_;
  RigidMotion<double> accepted_, trial_;
  double size_, length_;  // length_: 1 / size_
  // share_: of the step, tried. slope_: of Phi down the step, at its start. moved_: since radii moved. renews_: share by
  // which the pass moves radii toward friction l.
  double step_[6] = {}, share_ = 0, slope_ = 0, moved_ = 0, reached_ = 0, renews_ = 0;
  int passes_ = 0;
  bool done_ = true;
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
