// Rigid motions of bodies that pairs join, with the least energy Phi: the quadratics of each body (solver/coarse/sums.h), and
// the envelopes of planes, spheres and pairs (solver/coarse/envelope.h).
//
// The passes are those of solver/coarse/newton.h, with one step for all bodies. A pair has 1 / k = sum w^2 / D, and its gap
// and slip follow the motions of its two points, along the normal of the iterate:
//   gap = d - r + n . m,   slip = t + (1 - n n^T) m,   m = m_A - m_B,   m_A = (R - 1) arm + v of the body of side A
#pragma once
#include "contact/pairs/multiplier.h"
#include "solver/coarse/newton.h"

#include <vector>

namespace pd::inline PD_TARGET {

// The point of a pair on one side.
struct PairSide {
  int body;          // of the island; -1: does not move
  Vec3<double> arm;  // from the centre of the body, at the iterate
};

struct CoarsePair {
  int number;  // in the list
  PairSide side[2];
  Vec3<double> normal, slip, force;  // toward side A; of the iterate; on side A, at the iterate
  double gap, yielding, friction;    // 1 / k
  double radius;                     // of friction

  Envelope<double> envelope() const { return {1.0 / yielding, force, normal}; }

  Surface<double> after(const Vec3<double>& move) const {
    return {normal, gap + dot(normal, move), slip + tangential(move, normal)};
  }
};

constexpr int most_island_passes = 64;  // most corrections take 5 to 30

class CoarseIsland {
 public:
  std::vector<CoarseBody> bodies;
  std::vector<CoarsePair> pairs;

  void begin() {
    rows_ = 6 * bodies.size();
    for (CoarsePair& pair : pairs) {
      const double along = dot(pair.force, pair.normal);
      pair.radius = along > 0 ? pair.friction * along : 0.0;
    }
    share_ = slope_ = moved_ = renews_ = 0;
    passes_ = 0;
    done_ = true;
    for (const CoarseBody& body : bodies) done_ = done_ && !body.moves();
  }

  bool is_done() const { return done_; }

  // What the next pass asks for.
  CoarseTrial<double> trial(int body) const {
    CoarseTrial<double> trial = bodies[body].trial();
    if (!is_single()) trial.renews = renews_;
    return trial;
  }

  // sums(body): of planes and spheres
  template <class Sums>
  void pass(const Sums& sums) {
    using S = ContactSums;
    if (is_single()) {  // the bits of a body that no pair lists
      bodies[0].pass(sums(0));
      done_ = bodies[0].is_done();
      return;
    }
    done_ = ++passes_ > most_island_passes;
    if (done_) return;
    matrix_.assign(rows_ * rows_, 0.0);
    right_.assign(rows_, 0.0);
    totals_ = {};
    double scale = 0, own_before = 0, own_after = 0;
    for (int n = 0; n < int(bodies.size()); ++n) {
      CoarseBody& body = bodies[n];
      const auto& sum = sums(n);
      own_before += body.energy(body.accepted_);
      own_after += body.energy(body.trial_);
      totals_.before += sum[S::before];
      totals_.after += sum[S::after];
      totals_.lag += sum[S::lag];
      totals_.radius += sum[S::radius];
      scale += body.body_.weight * body.body_.square;
      add_body(n, sum);
    }
    for (CoarsePair& pair : pairs) add_pair(pair);
    const double rounding = energy_rounding * (scale + totals_.before);
    const bool falls = own_after + totals_.after <= own_before + totals_.before + rounding;
    if (share_ > 0 && !ends_step(falls)) return try_step();
    for (CoarseBody& body : bodies) body.accepted_ = body.trial_;
    moved_ += share_ * length_of_step();
    decide();
  }

  // The force of a pair, changed by the motions. What its gap and slip at the iterate add is left to iterations: forces that
  // grow with them while nothing yields would swing.
  Vec3<double> force(const CoarsePair& pair) const {
    const auto accepted = [&](int n) -> const RigidMotion<double>& { return bodies[n].accepted_; };
    const Envelope<double> envelope = pair.envelope();
    const Surface<double> at = pair.after(move_of(pair, accepted));
    const Vec3<double> after = envelope.force(at, pair.radius);
    const double radius = pair.friction * envelope.normal_force(at.gap);
    const Vec3<double> before = envelope.force(pair.after({0, 0, 0}), radius);
    const Vec3<double> force = envelope.anchor(pair.normal) + (after - before);
    const double along = dot(force, pair.normal), normal = along > 0 ? along : 0.0;
    const Vec3<double> across = onto_disc(tangential(force, pair.normal), pair.friction * normal);
    return multiply_add(normal, pair.normal, across);
  }

  // w of the turn of a body by 2 atan(|w| / 2): Cayley's formula backward.
  Vec3<double> turn(int body) const {
    const Mat3<double>& turn = bodies[body].accepted_.turn;
    return (2.0 / (4.0 + trace(turn))) * axis_of(turn);
  }

  // Whether no body turns by more than a right angle: where one does, other pairs would hold it.
  bool is_valid() const {
    bool valid = true;
    for (int n = 0; n < int(bodies.size()); ++n) {
      const Vec3<double> w = turn(n);
      valid = valid && 4.0 + trace(bodies[n].accepted_.turn) > 0 && !(dot(w, w) > 4.0);
    }
    return valid;
  }

  // The force at the gap and slip after other motions, motion_of(body).
  template <class Motion>
  Vec3<double> force_after(const CoarsePair& pair, const Motion& motion_of) const {
    const Envelope<double> envelope = pair.envelope();
    const Surface<double> at = pair.after(move_of(pair, motion_of));
    return envelope.force(at, pair.friction * envelope.normal_force(at.gap));
  }

 private:
  bool is_single() const { return bodies.size() == 1 && pairs.empty(); }

  // d = the displacement of the point of a side by the motion of its body
  template <class Motion>
  Vec3<double> move_of(const CoarsePair& pair, const Motion& motion_of) const {
    Vec3<double> move[2] = {{0, 0, 0}, {0, 0, 0}};
    for (int s = 0; s < 2; ++s) {
      const PairSide& side = pair.side[s];
      if (side.body < 0) continue;
      const RigidMotion<double>& motion = motion_of(side.body);
      move[s] = motion.turn * side.arm + motion.shift;
    }
    return move[0] - move[1];
  }

  double& entry(std::size_t row, std::size_t column) { return matrix_[column * rows_ + row]; }

  template <class Sum>
  void add_body(int n, const Sum& sum) {
    double terms[CoarseBody::terms_count];
    bodies[n].find_terms(sum, terms);
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c <= r; ++c) entry(6 * n + r, 6 * n + c) = terms[CoarseBody::at(r, c)];
      right_[6 * n + r] = terms[CoarseBody::at(6, r)];
    }
  }

  // Displacement of the point of a side, after the trial, by a twist of its body in lengths; as columns.
  void find_columns(const PairSide& side, double sign, Vec3<double> (&column)[6]) const {
    const CoarseBody& body = bodies[side.body];
    const Vec3<double> none = {0, 0, 0}, arm = side.arm + body.trial_.turn * side.arm;
    const Mat3<double> turns = transpose((-sign * body.length_) * cross_matrix(arm));
    const bool shifts = body.body_.hold == Hold::none;
    for (int c = 0; c < 3; ++c) {
      column[c] = none;
      column[3 + c] = turns.row[c];
    }
    if (shifts) column[0].x = column[1].y = column[2].z = sign;
    if (body.body_.hold == Hold::line) {
      const Vec3<double>& axis = body.body_.axis;
      const Vec3<double> about = axis * turns;
      column[3] = axis.x * about, column[4] = axis.y * about, column[5] = axis.z * about;
    }
  }

  void add_pair(CoarsePair& pair) {
    const auto accepted = [&](int n) -> const RigidMotion<double>& { return bodies[n].accepted_; };
    const auto trial = [&](int n) -> const RigidMotion<double>& { return bodies[n].trial_; };
    const Envelope<double> envelope = pair.envelope();
    const Surface<double> before = pair.after(move_of(pair, accepted)),
                          after = pair.after(move_of(pair, trial));
    totals_.before += pair.yielding * envelope.energy(before, pair.radius);
    totals_.after += pair.yielding * envelope.energy(after, pair.radius);
    const double normal = envelope.normal_force(after.gap);
    pair.radius = multiply_add(renews_, pair.friction * normal - pair.radius, pair.radius);
    const double lag = pair.friction * normal - pair.radius;
    totals_.lag += lag * lag;
    totals_.radius += pair.radius * pair.radius;
    const auto rub = envelope.rub(after.slip, pair.radius);
    const double across = rub.share * envelope.stiffness,
                 along = normal > 0 ? envelope.stiffness : 0.0;
    if (!(across > 0) && !(along > 0)) return;
    const Vec3<double> force = multiply_add(normal, pair.normal, rub.share * rub.pull);
    Vec3<double> column[2][6], stiff[2][6];
    for (int s = 0; s < 2; ++s) {
      if (pair.side[s].body < 0) continue;
      find_columns(pair.side[s], s == 0 ? 1.0 : -1.0, column[s]);
      for (int c = 0; c < 6; ++c) {
        const double height = (along - across) * dot(pair.normal, column[s][c]);
        stiff[s][c] = multiply_add(height, pair.normal, across * column[s][c]);
        right_[6 * pair.side[s].body + c] += dot(column[s][c], force);
      }
    }
    for (int s = 0; s < 2; ++s) {
      for (int t = 0; t < 2; ++t) {
        const int row = pair.side[s].body, col = pair.side[t].body;
        if (row < 0 || col < 0 || row < col) continue;
        for (int r = 0; r < 6; ++r) {
          for (int c = 0; c < (s == t ? r + 1 : 6); ++c)
            entry(6 * row + r, 6 * col + c) += dot(column[s][r], stiff[t][c]);
        }
      }
    }
  }

  // Whether the trial is good enough; else how much of the step to try next.
  bool ends_step(bool falls) {
    way_.resize(rows_);
    for (std::size_t n = 0; n < bodies.size(); ++n) {
      const Vec3<double> turn = share_ * bodies[n].turn_of(bodies[n].step_);
      const double rate = 1.0 / (1.0 + 0.25 * dot(turn, turn));
      for (int i = 0; i < 6; ++i) way_[6 * n + i] = (i < 3 ? 1.0 : rate) * bodies[n].step_[i];
    }
    double slope = 0, second = 0;
    for (std::size_t c = 0; c < rows_; ++c) {
      slope -= right_[c] * way_[c];
      second += way_[c] * way_[c] * entry(c, c);
      for (std::size_t r = c + 1; r < rows_; ++r) second += 2 * way_[c] * way_[r] * entry(r, c);
    }
    if (falls && slope <= flat_share * slope_) return true;
    const double next = share_ - slope / second;
    share_ = 0 < next && next < share_ ? next : 0.5 * share_;
    return false;
  }

  // From the terms at the accepted motions: Newton's step, or radii are renewed. A small step is the last.
  void decide() {
    way_ = right_;
    solve();
    slope_ = 0;
    for (std::size_t i = 0; i < rows_; ++i) {
      bodies[i / 6].step_[i % 6] = right_[i];
      slope_ += way_[i] * right_[i];
    }
    const double length = length_of_step();
    const bool behind = totals_.lag > lag_share * lag_share * totals_.radius;
    share_ = 1;
    renews_ = 0;
    if (behind && (length <= still_share || length <= settled_share * moved_)) {
      renews_ = totals_.lag <= settled_share * settled_share * totals_.radius ? 1.0 : 0.5;
      share_ = moved_ = 0;  // a pass at the accepted motions
    }
    try_step();
    done_ = !behind && length <= still_share;
    if (done_) {
      for (CoarseBody& body : bodies) body.accepted_ = body.trial_;
    }
  }

  // The largest of the bodies, over their sizes.
  double length_of_step() const {
    double most = 0;
    for (const CoarseBody& body : bodies) {
      const double length = body.length_ * CoarseBody::length_of(body.step_);
      most = length > most ? length : most;
    }
    return most;
  }

  void try_step() {
    for (CoarseBody& body : bodies) {
      body.share_ = share_;
      body.try_step();
    }
  }

  // right = x with A x = right for an A that is not negative, 0 along rows without pivot: A = L D L^T. The matrix is lost.
  void solve() {
    const std::size_t n = rows_;
    double most = 0;
    for (std::size_t i = 0; i < n; ++i) most = entry(i, i) > most ? entry(i, i) : most;
    inverse_.resize(n);
    for (std::size_t j = 0; j < n; ++j) {
      const double* const column = matrix_.data() + j * n;
      inverse_[j] = column[j] > no_pivot * most ? 1.0 / column[j] : 0.0;
      for (std::size_t c = j + 1; c < n; ++c) {
        const double factor = inverse_[j] * column[c];
        if (factor == 0) continue;
        double* const to = matrix_.data() + c * n;
        for (std::size_t r = c; r < n; ++r) to[r] -= factor * column[r];
        right_[c] -= factor * right_[j];
      }
    }
    for (std::size_t j = n; j-- > 0;) {
      double sum = right_[j];
      for (std::size_t r = j + 1; r < n; ++r) sum -= entry(r, j) * right_[r];
      right_[j] = inverse_[j] * sum;
    }
  }

  struct Totals {
    double before = 0, after = 0, lag = 0, radius = 0;
  };

  std::size_t rows_ = 0;
  std::vector<double> matrix_, right_, way_, inverse_;  // lower triangle, column by column
  Totals totals_;
  double share_ = 0, slope_ = 0, moved_ = 0, renews_ = 0;
  int passes_ = 0;
  bool done_ = true;
};

}  // namespace pd::inline PD_TARGET
