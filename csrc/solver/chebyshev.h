// The weights omega of the Chebyshev semi-iterative method for one environment, and their restarts.
//
//   classic   omega = 1 for k < S;  2 / (2 - rho^2) at k = S;  4 / (4 - rho^2 omega) after     (Wang 2015, eq. 14)
//   guarded   omega = 1 + min(b, n / (n + 3)), b = ((1 - sqrt(1 - rho^2)) / rho)^2 the limit of the classic sequence,
//             n the iterations since the last restart
//
// The guarded schedule restarts when the energy rose between two checks. With n = 0 the step is plain descent on the
// weighted diagonal, which never raises the energy. E(u_k) affects omega from k + 2 on, so that blocks of threads
// need not wait for each other's sums.
//
// Jacobi's iteration multiplies an error mode by g. With a weight omega the factor is the larger root |r| of r^2 -
// omega g r + omega - 1 = 0 (Young 1971, chapter 5). For a real root, an iteration changes 1 - r of the mode. For
// complex roots the mode oscillates: at a turning point an iteration changes nothing of it, but its bound falls by
// |r|.
#pragma once
#include "math/scalar.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

constexpr int guard_period = 4;       // iterations between two energy checks
static_assert(guard_period > 1);      // the schedule uses a check before the next one
constexpr double guard_slack = 1e-5;  // relative rise that rounding may cause
constexpr double guard_slack_friction =
    1e-2;  // the energy lacks the work of friction, and may rise by it
constexpr double largest_rho = 0.99999;

// What the change of one iteration says about the error. `changed` is a lower bound of change over error; `kept` is
// the share of the error seen in an earlier change that may remain.
struct ErrorShare {
  double changed = 1, kept = 0;
};

struct Schedule {
  ScheduleKind kind;
  double rho;
  double slowest;  // largest g of any mode: A >= mu D
  int delay;
  double slack = guard_slack;
  double limit = 0, omega = 1, last_energy = HUGE_VAL;
  int momentum = 0, restarts = 0;

  Schedule() = default;

  // `mu` is the smallest ratio of inertia to diagonal.
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

  // Error share of an iteration with weight omega, for the slowest mode.
  PD_HD ErrorShare error_share(double omega) const {
    const double sum = omega * slowest, discriminant = sum * sum - 4 * (omega - 1);
    // at the limit the discriminant is zero but for rounding, also that of a float's omega
    const bool real = discriminant > 1e-6;
    const double r = ((real ? sum : 0) + sqrt(real ? discriminant : 4 * (omega - 1))) / 2;
    return {1 - r, real ? 0 : r};
  }

  PD_HD static double in_range(double rho) {
    rho = rho < largest_rho ? rho : largest_rho;
    return rho > 0 ? rho : 0;
  }

  PD_HD bool checks_energy(int k) const {
    return kind == ScheduleKind::guarded && k % guard_period == 0;
  }

  // Takes E(u_k) after next(k + 1) and before next(k + 2): a restart makes omega_{k+2} 1.
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
