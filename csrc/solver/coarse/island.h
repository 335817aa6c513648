// Rigid motions of bodies that pairs join, with the least energy Phi: the quadratics of each body (solver/coarse/sums.h),
// and the envelopes of planes, spheres and pairs (solver/coarse/envelope.h).
//
// The passes are those of solver/coarse/newton.h, with one step for all bodies. A pair has 1 / k = sum w^2 / D, and its gap
// and slip follow the motions of its two points, along the normal of the iterate:
//   gap = d - r + n . m,   slip = t + (1 - n n^T) m,   m = m_A - m_B,   m_A = (R - 1) arm + v of the body of side A
#pragma once
#include "contact/pairs/multiplier.h"
#include "solver/coarse/newton.h"

#include <cstdint>

namespace pd::inline PD_TARGET {

// The point of a pair on one side.
struct CoarseSide {
  int body;          // -1: does not move
  Vec3<double> arm;  // from the centre of the body, at the iterate
};

struct CoarsePair {
  CoarseSide side[2];
  Vec3<double> normal, slip, force;  // toward side A; of the iterate; on side A, at the iterate
  double gap, yielding, friction;    // 1 / k

  PD_HD Envelope<double> envelope() const { return {1.0 / yielding, force, normal}; }

  PD_HD Surface<double> after(const Vec3<double>& move) const {
    return {normal, gap + dot(normal, move), slip + tangential(move, normal)};
  }

  // The displacement of side A from side B by motion_of(body).
  template <class Motion>
  PD_HD Vec3<double> move_of(const Motion& motion_of) const {
    Vec3<double> move = {0, 0, 0};
    for (int s = 0; s < 2; ++s) {
      if (side[s].body < 0) continue;
      const RigidMotion<double>& motion = motion_of(side[s].body);
      const Vec3<double> own = motion.turn * side[s].arm + motion.shift;
      move = s == 0 ? move + own : move - own;
    }
    return move;
  }

  // mu l before any motion
  PD_HD double first_radius() const {
    const double along = dot(force, normal);
    return along > 0 ? friction * along : 0.0;
  }

  // The force, changed by motions. What the gap and slip at the iterate add is left to iterations: forces that grow with
  // them while nothing yields would swing.
  template <class Motion>
  PD_HD Vec3<double> force_changed_by(const Motion& motion_of, double radius) const {
    const Envelope<double> of = envelope();
    const Surface<double> at = after(move_of(motion_of));
    const Vec3<double> moved = of.force(at, radius),
                       still = of.force(after({0, 0, 0}), friction * of.normal_force(at.gap));
    const Vec3<double> force = of.anchor(normal) + (moved - still);
    const double along = dot(force, normal), least = along > 0 ? along : 0.0;
    return multiply_add(least, normal, onto_disc(tangential(force, normal), friction * least));
  }

  // The force at the gap and slip after motions.
  template <class Motion>
  PD_HD Vec3<double> force_after(const Motion& motion_of, double radius) const {
    return envelope().force(after(move_of(motion_of)), radius);
  }
};

// What a pair adds to a pass: on its side A, of a force that is opposite on B.
struct PairTerms {
  double before, after, lag, radius;
  Vec3<double> arm[2], normal, force;
  double across, along;
  int other[2];  // of sweeps: the collider with a mass on the other side, or -1

  // For the body of one side; energies count once, on the first side that moves.
  PD_HD ContactTerms<double> of_side(int s, bool counts) const {
    const double sign = s == 0 ? 1.0 : -1.0, once = counts ? 1.0 : 0.0;
    return {once * before, once * after, once * lag, once * radius, arm[s],
            normal,        sign * force, across,     along};
  }

  PD_HD bool resists() const { return across > 0 || along > 0; }
};

// `bodies`: all, by the numbers of sides; `renews`: share by which the radius moves toward friction l.
PD_HD PairTerms terms_of(const CoarsePair& pair, const CoarseBody* bodies, double renews,
                         double& radius) {
  const auto trial = [&](int n) -> const RigidMotion<double>& { return bodies[n].next_motion(); };
  const auto accepted = [&](int n) -> const RigidMotion<double>& { return bodies[n].motion(); };
  const Envelope<double> envelope = pair.envelope();
  const Surface<double> before = pair.after(pair.move_of(accepted)),
                        after = pair.after(pair.move_of(trial));
  PairTerms terms;
  terms.before = pair.yielding * envelope.energy(before, radius);
  terms.after = pair.yielding * envelope.energy(after, radius);
  const double normal = envelope.normal_force(after.gap);
  radius = multiply_add(renews, pair.friction * normal - radius, radius);
  terms.lag = pair.friction * normal - radius;
  terms.radius = radius;
  const auto rub = envelope.rub(after.slip, radius);
  terms.across = rub.share * envelope.stiffness;
  terms.along = normal > 0 ? envelope.stiffness : 0.0;
  terms.normal = pair.normal;
  terms.force = multiply_add(normal, pair.normal, rub.share * rub.pull);
  for (int s = 0; s < 2; ++s) {
    const Vec3<double>& arm = pair.side[s].arm;
    terms.arm[s] = pair.side[s].body < 0 ? arm : arm + trial(pair.side[s].body).turn * arm;
  }
  return terms;
}

// Second derivative of Phi by the twists of two bodies, row by row: of `row` first.
struct CoupleSums {
  static constexpr int count = 36;
};

// Adds J_row^T k J_column of a pair, J the displacement of its points by twists. `row`: side of the body of the rows.
PD_HD void add_couple(double (&sum)[CoupleSums::count], const PairTerms& of, int row) {
  const auto column = [&](int side, int c) -> Vec3<double> {
    const Vec3<double>& arm = of.arm[side];
    const double one = 1.0;
    return c == 0   ? Vec3<double>{one, 0, 0}
           : c == 1 ? Vec3<double>{0, one, 0}
           : c == 2 ? Vec3<double>{0, 0, one}
           : c == 3 ? Vec3<double>{0, -arm.z, arm.y}
           : c == 4 ? Vec3<double>{arm.z, 0, -arm.x}
                    : Vec3<double>{-arm.y, arm.x, 0};
  };
  PD_UNROLL
  for (int c = 0; c < 6; ++c) {
    const Vec3<double> moved = column(1 - row, c);
    const double height = (of.along - of.across) * dot(of.normal, moved);
    const Vec3<double> stiff = multiply_add(height, of.normal, of.across * moved);
    PD_UNROLL
    for (int r = 0; r < 6; ++r) sum[6 * r + c] -= dot(column(row, r), stiff);
  }
}

constexpr int most_island_passes = 64;  // most corrections take 5 to 30

// The bodies of an island, and its step. Memory is of the caller, for islands of an environment one after another.
class CoarseIsland {
 public:
  CoarseIsland() = default;

  // `member`: [count] numbers of bodies. `matrix`: `entries_of(count)`; `numbers`: three times [6 count]
  PD_HD CoarseIsland(CoarseBody* bodies, const int* member, int count, double* matrix,
                     double* numbers)
      : bodies_(bodies),
        member_(member),
        count_(count),
        matrix_(matrix),
        right_(numbers),
        way_(numbers + 6 * count),
        inverse_(numbers + 12 * count) {
    for (int n = 0; n < count; ++n) done_ = done_ && !body(n).moves();
  }

  // of the lower triangle [6 count, 6 count], column by column
  PD_HD static std::int64_t entries_of(int count) {
    return 3 * std::int64_t(count) * (6 * std::int64_t(count) + 1);
  }

  PD_HD bool is_done() const { return done_; }
  PD_HD double renews() const { return renews_; }
  // what the next pass asks of a body
  PD_HD CoarseTrial<double> trial_of(const CoarseBody& body) const {
    CoarseTrial<double> trial = body.trial();
    trial.renews = renews_;
    return trial;
  }

  // Sets the block of two members, the row after the column, to its sums.
  PD_HD void set_couple(int row, int column, const double (&sum)[CoupleSums::count]) {
    for (int c = 0; c < 6; ++c) {
      for (int r = 0; r < 6; ++r) entry(6 * row + r, 6 * column + c) = sum[6 * r + c];
    }
  }

  // `sums`: ContactSums of all bodies, by their numbers. Couples are set. A group of threads shares what grows with the
  // number of bodies; one takes the rest.
  template <class Group>
  PD_CALLED void pass(const Group& group, const double* sums) {
    const int count = count_;
    group.each_of_group(count, [&](int n) { add_body(n, sums + member_[n] * ContactSums::count); });
    // blocks of couples by twists in lengths that pins leave
    for (int n = 0; n < count; ++n)
      group.each_of_group(6 * count, [&](int line) { keep_couple(n, line / 6, line % 6); });
    group.lead([&] {
      done_ = ++passes_ > most_island_passes;
      solves_ = !done_ && weigh(sums);
    });
    if (!solves_) return;
    solve(group);
    group.lead([&] { decide(); });
  }

  // Whether no body turns by more than a right angle: where one does, other pairs would hold it.
  PD_HD bool is_valid() const {
    bool valid = true;
    for (int n = 0; n < count_; ++n) {
      const RigidMotion<double>& motion = body(n).accepted_;
      const Vec3<double> w = turn_vector(motion);
      valid = valid && 4.0 + trace(motion.turn) > 0 && !(dot(w, w) > 4.0);
    }
    return valid;
  }

 private:
  PD_HD CoarseBody& body(int n) const { return bodies_[member_[n]]; }
  PD_HD int rows() const { return 6 * count_; }
  PD_HD double& entry(int row, int column) const {
    const std::int64_t c = column;
    return matrix_[c * rows() - c * (c + 1) / 2 + row];
  }

  PD_HD void add_body(int n, const double* sums) {
    double sum[ContactSums::count], terms[CoarseBody::terms_count];
    for (int i = 0; i < ContactSums::count; ++i) sum[i] = sums[i];
    body(n).find_terms(sum, terms);
    for (int r = 0; r < 6; ++r) {
      for (int c = 0; c <= r; ++c) entry(6 * n + r, 6 * n + c) = terms[CoarseBody::at(r, c)];
      right_[6 * n + r] = terms[CoarseBody::at(6, r)];
    }
  }

  // A line of the block of members n and m, by the twist of n.
  PD_HD void keep_couple(int n, int m, int k) {
    if (m == n) return;
    double line[6];
    const auto at = [&](int i) -> double& {
      return m < n ? entry(6 * n + i, 6 * m + k) : entry(6 * m + k, 6 * n + i);
    };
    for (int i = 0; i < 6; ++i) line[i] = at(i);
    body(n).keep_twist(line);
    for (int i = 0; i < 6; ++i) at(i) = line[i];
  }

  // Judges the trial. Whether it is accepted, and the next step must be found.
  PD_HD bool weigh(const double* sums) {
    using S = ContactSums;
    double scale = 0, own_before = 0, own_after = 0, before = 0, after = 0;
    lag_ = radius_ = 0;
    for (int n = 0; n < count_; ++n) {
      const CoarseBody& of = body(n);
      const double* const sum = sums + member_[n] * S::count;
      own_before += of.energy(of.accepted_);
      own_after += of.energy(of.trial_);
      before += sum[S::before], after += sum[S::after];
      lag_ += sum[S::lag], radius_ += sum[S::radius];
      scale += of.body_.weight * of.body_.square;
    }
    const double rounding = energy_rounding * (scale + before);
    const bool falls = own_after + after <= own_before + before + rounding;
    if (share_ > 0 && !ends_step(falls)) {
      try_step();
      return false;
    }
    for (int n = 0; n < count_; ++n) body(n).accepted_ = body(n).trial_;
    moved_ += share_ * length_of_step();
    for (int i = 0; i < rows(); ++i) way_[i] = right_[i];
    return true;
  }

  // Whether the trial is good enough; else how much of the step to try next.
  PD_HD bool ends_step(bool falls) {
    for (int n = 0; n < count_; ++n) {
      const Vec3<double> turn = share_ * body(n).turn_of(body(n).step_);
      const double rate = 1.0 / (1.0 + 0.25 * dot(turn, turn));
      for (int i = 0; i < 6; ++i) way_[6 * n + i] = (i < 3 ? 1.0 : rate) * body(n).step_[i];
    }
    double slope = 0, second = 0;
    for (int c = 0; c < rows(); ++c) {
      slope -= right_[c] * way_[c];
      second += way_[c] * way_[c] * entry(c, c);
      for (int r = c + 1; r < rows(); ++r) second += 2 * way_[c] * way_[r] * entry(r, c);
    }
    if (falls && slope <= flat_share * slope_) return true;
    const double next = share_ - slope / second;
    share_ = 0 < next && next < share_ ? next : 0.5 * share_;
    return false;
  }

  // Newton's step from the accepted motions, or radii are renewed. A small step is the last.
  PD_HD void decide() {
    slope_ = 0;
    for (int i = 0; i < rows(); ++i) {
      body(i / 6).step_[i % 6] = right_[i];
      slope_ += way_[i] * right_[i];
    }
    const double length = length_of_step();
    const bool behind = lag_ > lag_share * lag_share * radius_;
    share_ = 1;
    renews_ = 0;
    if (behind && (length <= still_share || length <= settled_share * moved_)) {
      renews_ = lag_ <= settled_share * settled_share * radius_ ? 1.0 : 0.5;
      share_ = moved_ = 0;  // a pass at the accepted motions
    }
    try_step();
    done_ = !behind && length <= still_share;
    if (done_) {
      for (int n = 0; n < count_; ++n) body(n).accepted_ = body(n).trial_;
    }
  }

  // The largest of the bodies, over their sizes.
  PD_HD double length_of_step() const {
    double most = 0;
    for (int n = 0; n < count_; ++n) {
      const double length = body(n).length_ * CoarseBody::length_of(body(n).step_);
      most = length > most ? length : most;
    }
    return most;
  }

  PD_HD void try_step() {
    for (int n = 0; n < count_; ++n) {
      body(n).share_ = share_;
      body(n).try_step();
    }
  }

  // right = x with A x = right for an A that is not negative, 0 along rows without pivot: A = L D L^T. The matrix is lost.
  template <class Group>
  PD_HD void solve(const Group& group) {
    const int n = rows();
    group.lead([&] {
      most_ = 0;
      for (int i = 0; i < n; ++i) most_ = entry(i, i) > most_ ? entry(i, i) : most_;
    });
    for (int j = 0; j < n; ++j) {
      const double pivot = entry(j, j), inverse = pivot > no_pivot * most_ ? 1.0 / pivot : 0.0;
      group.spread_of_group(n - j - 1, [&](int at) {
        right_[j + 1 + at] -= inverse * entry(j + 1 + at, j) * right_[j];
      });
      group.each_below(j + 1, n,
                       [&](int r, int c) { entry(r, c) -= inverse * entry(c, j) * entry(r, j); });
      if (group.leads()) inverse_[j] = inverse;
    }
    for (int j = n - 1; j >= 0; --j) {
      group.lead([&] { right_[j] *= inverse_[j]; });
      group.each_of_group(j, [&](int i) { right_[i] -= entry(j, i) * right_[j]; });
    }
  }

  CoarseBody* bodies_ = nullptr;
  const int* member_ = nullptr;
  int count_ = 0, passes_ = 0;
  double *matrix_ = nullptr, *right_ = nullptr, *way_ = nullptr, *inverse_ = nullptr;
  double share_ = 0, slope_ = 0, moved_ = 0, renews_ = 0;
  double lag_ = 0, radius_ = 0, most_ = 0;  // of a pass
  bool done_ = true, solves_ = false;
};

}  // namespace pd::inline PD_TARGET
