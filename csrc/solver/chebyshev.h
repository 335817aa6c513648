// The weights omega of the semi-iterative method, one environment, and when they start afresh.
//
// classic   omega = 1 for k < S;  2 / (2 - rho^2) at k = S;  4 / (4 - rho^2 omega) after     (Wang 2015, eq. 14)
// guarded   omega = 1 + min(b, n / (n + 3)), b = ((1 - sqrt(1 - rho^2)) / rho)^2 the limit of the classic sequence,
//           n counted from the last restart; a restart whenever the energy rose between two checks. With n = 0 the step
//           is plain descent on the weighted diagonal, which never raises the energy. E(u_k) decides on omega from k + 2
//           on, so that blocks of threads need not wait for each other's sums.
//
// With a weight omega an iteration leaves of a mode, of which one of Jacobi's leaves g, the larger root |r| of
// r^2 - omega g r + omega - 1 = 0 (Young 1971, chapter 5). A real one changes 1 - r of it. Where the roots are complex the mode
// swings, and at its turning points an iteration changes nothing of it, however large it is; but what it can be falls by |r|.
#pragma once
#include "math/scalar.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

constexpr int guard_period = 4;       // iterations from one look at the energy to the next
static_assert(guard_period > 1);      // a verdict falls before the next look
constexpr double guard_slack = 1e-5;  // relative rise that rounding may cause
constexpr double guard_slack_friction =
    1e-2;  // the energy lacks the work of friction, and may rise by it
constexpr double largest_rho = 0.99999;

// What the change of an iteration says of the error: the least share of it that this is, and how much is left of the error that
// an earlier change showed.
struct Share {
  double changed = 1, kept = 0;
};

struct Schedule {
  ScheduleKind kind;
  double rho;
  double slowest;  // no mode has more than this g: A >= mu D
  int delay;
  double slack = guard_slack;
  double limit = 0, omega = 1, last_energy = HUGE_VAL;
  int momentum = 0, restarts = 0;

  Schedule() = default;

  // `mu` is the smallest ratio of inertia to diagonal
  PD_HD Schedule(const Settings& settings, double mu, bool friction)
      : kind(settings.schedule),
        rho(settings.rho),
        delay(settings.delay),
        slack(friction ? guard_slack_friction : guard_slack) {
    const double bound = 1 - settings.relaxation * mu;
    slowest = bound > 0 ? bound : 0;
    rho = in_range(rho > 0 ? rho : bound);
    const double ratio = rho > 0 ? (1 - sqrt(1 - rho * rho)) / rho : 0;
    limit = ratio * ratio;
  }

  PD_HD double next(int k) {
    if (kind == ScheduleKind::classic) {
      if (k == delay) omega = 2 / (2 - rho * rho);
      if (k > delay) omega = 4 / (4 - rho * rho * omega);
    } else if (kind == ScheduleKind::guarded) {
      const double ramp = momentum / (momentum + 3.0);
      omega = 1 + (ramp < limit ? ramp : limit);
      ++momentum;
    }
    return omega;
  }

  // Of an iteration of weight omega, by the slowest mode.
  PD_HD Share share_of(double omega) const {
    const double sum = omega * slowest, discriminant = sum * sum - 4 * (omega - 1);
    // at the limit it is zero but for rounding, of a float's omega too
    const bool real = discriminant > 1e-6;
    const double r = ((real ? sum : 0) + sqrt(real ? discriminant : 4 * (omega - 1))) / 2;
    return {1 - r, real ? 0 : r};
  }

  PD_HD static double in_range(double rho) {
    rho = rho < largest_rho ? rho : largest_rho;
    return rho > 0 ? rho : 0;
  }

  PD_HD bool wants_energy(int k) const {
    return kind == ScheduleKind::guarded && k % guard_period == 0;
  }

  // E(u_k), after next(k + 1) and before next(k + 2): a restart makes omega_{k+2} 1.
  PD_HD void check(double energy) {
    const bool rose = energy > last_energy + slack * absolute(last_energy);
    if (rose) {
      momentum = 0;
      ++restarts;
    }
    last_energy = energy;
  }
};

}  // namespace pd::inline PD_TARGET
