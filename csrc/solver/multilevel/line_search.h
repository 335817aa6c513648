// Globalisation of solver/multilevel/lbfgs.h for one environment, numbers only: accepts trials, and chooses the next step
// length and method. Trials that fail fall back on accelerated Jacobi iterations.
#pragma once
#include "math/scalar.h"
#include "solver/chebyshev.h"
#include "solver/multilevel/material_mismatch.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

constexpr double armijo_factor = 1e-4;  // share of the decrease that the slope predicts (Armijo)
// factor of the step length after a failed trial: a body that lands has contacts within micrometres
constexpr double step_reduction = 0.5, contact_step_reduction = 0.25;
constexpr int failures_before_clearing = 2;             // failed trials before L-BFGS restarts
constexpr int most_reductions = 12;                     // before a fallback of Jacobi iterations
constexpr int fallback_length = 2, most_doublings = 3;  // of the first fallback; of that length
constexpr int friction_fallback_length = 8;             // of every one with friction
constexpr int unsettled_fallbacks = 3,
              unsettled_failures = 2;     // with friction the first fallbacks come earlier
constexpr int failures_before_plain = 4;  // failed accelerated iterations before a plain one
// Without contacts the coarse problem is rebuilt after so many trials in a row that lowered E by less than this share of what the
// slope promises, half of it at full length: then H has changed.
constexpr double slow_share = 0.75;
constexpr int slow_trials = 2;
// With contacts: share of the path of a step after which it is rebuilt; that costs one or two iterations
constexpr double coarse_rebuild_share = 0.1;
constexpr double least_step_length = 1e-8;

constexpr double momentum_rho = 0.9995;  // the radius of M A is unknown, and this limit serves all

// Estimated share of an error that a full step with M changes, if rotating parts have no coarse problem or M holds
// other vertices than the step. M is poorest there, and this is no bound. The error of an earlier trial decays over
// some trials: one that changes little may stand between two that change much.
constexpr double rotating_share = 0.25;
constexpr double rotating_kept = 0.5, coarse_kept = 0.25;

// Factor of theta while contacts without friction hold vertices. P M P has eigenvalues beyond 1 there for bending of
// a face, 4 for a cube of 15,625 vertices. If theta times them exceeds 2, one trial after another fails. A quarter
// would serve large faces better, and small ones worse.
constexpr double contact_relaxation = 0.5;

// Relative rounding of E: a smaller rise has no meaning.
template <class T>
PD_HD constexpr double energy_noise() {
  return sizeof(T) == 4 ? 1e-5 : 1e-12;
}

// State of an environment: the current trial, and the outcome of those before.
struct LineSearch {
  double scale = 1;              // M / scale fits the material of the step
  double energy = 0, slope = 0;  // at the iterate; g.d of the direction there
  double slack = 0;
  int failures = 0, restarts = 0, momentum = 0;
  double material_fit = 1;  // least share of the error that M changes under material mismatch
  bool learns = false, touches = false;  // L-BFGS; there are contacts
  // of the current trial: its weight if it is a Jacobi iteration; else 0, and its error share
  double omega = 0;
  ErrorShare share;
  StoppingTest stop;
  int fallback_left = 0;  // iterations left of a fallback
  bool plain_jacobi = false, accepted = true, known = false;
  bool friction = false, overshoots = false;  // the latter: the trial of Newton's method
  // accelerated Jacobi iterations: to the end of the step with momentum, during a fallback with L-BFGS
  bool jacobi = false;
  // the step length without failures, the number of reductions, and the fallbacks of the step
  double step_length = 1;
  int reductions = 0, fallbacks = 0;
  // path length of accepted trials: in all, and since the coarse problem was built
  double path = 0, path_since_coarse = 0;
  int slow = 0;  // trials in a row that lowered E by less than the slope promises

  // step length of the next trial
  PD_HD double trial_length() const {
    double length = step_length;
    for (int i = 0; learns && i < failures; ++i) length *= reduction();
    return length;
  }

  // Weight of M in a step; `held`: the coarse problem includes contacts.
  PD_HD double weight(double relaxation, bool held) const {
    return full(held) * relaxation / scale;
  }

  // Whether a trial of this energy is accepted; `work` is the part against friction. NaN is not, unless it is the
  // first trial.
  PD_HD bool accept(double trial, double work) {
    const double length_taken = trial_length();
    const bool preconditioned = !plain_jacobi && !jacobi;
    const double demanded = learns && preconditioned ? armijo_factor * length_taken * slope : 0;
    if (preconditioned) judge(trial, length_taken);
    const bool decreased =
        !overshoots && (!known || trial <= energy - demanded + slack * absolute(energy));
    // friction has no energy: with it the Jacobi iteration is a fixed-point map, and continues
    accepted = decreased || ((plain_jacobi || jacobi) && friction && trial < HUGE_VAL);
    restarts += !decreased;
    const bool repeated = failures > 0;
    failures = accepted ? 0 : failures + 1;
    if (!decreased) momentum = 0;
    if (accepted) {
      known = true;
      // the friction of another iterate does other work
      energy = trial - work;
    }
    if (learns && !jacobi) {
      plain_jacobi = false;
      if (preconditioned) update_step_length(length_taken, repeated);
      return accepted;
    }
    if (learns) {
      jacobi = --fallback_left > 0;
      // the momentum failed
      if (!jacobi) failures = 0;
    } else {
      // without momentum M alone descends, if it fits
      jacobi = jacobi || failures > 1;
    }
    plain_jacobi = failures >= failures_before_plain;
    return accepted;
  }

  // whether L-BFGS clears all pairs; a trial that failed adds none
  PD_HD bool clears_pairs() const {
    return plain_jacobi || jacobi || failures == failures_before_clearing;
  }

  // `has_contacts`: there are some; `by_lbfgs`: with the coarse problem, else by momentum
  PD_HD void begin(const MaterialMismatch& mismatch, bool has_contacts, bool has_friction,
                   bool by_lbfgs, double noise, double free_fall) {
    *this = {};
    scale = mismatch.scale;
    material_fit = mismatch.spread < 1 ? 1 - mismatch.spread : rotating_share;
    friction = has_friction;
    learns = by_lbfgs;
    touches = has_contacts;
    slack = noise;
    stop.free_fall = free_fall;
  }

  // Adds an accepted trial to the path, from its squared change.
  PD_HD void add_path(double change) {
    if (!accepted) return;
    path += sqrt(change);
    path_since_coarse += sqrt(change);
  }
  // whether to rebuild the coarse problem: with contacts in a step with failures, after enough of its path
  PD_HD bool rebuilds_coarse() const {
    return accepted && restarts > 0 && path_since_coarse > coarse_rebuild_share * path;
  }
  PD_HD bool is_outdated() const {
    return touches ? rebuilds_coarse() : slow >= slow_trials && path_since_coarse > 0;
  }
  PD_HD void rebuilt() {
    path_since_coarse = 0;
    slow = 0;
  }

  // The next direction is a new one of Newton's method: its full step comes first.
  PD_HD void renewed() {
    step_length = 1;
    reductions = 0;
  }

  // Whether the slope g.d of a direction is negative. If not, the secant pairs do not hold here.
  PD_HD bool descends(double derivative) {
    slope = derivative;
    if (slope >= 0 || plain_jacobi || jacobi) return true;
    plain_jacobi = true;
    ++restarts;
    return false;
  }

  // whether the next trial is an accelerated Jacobi iteration
  PD_HD bool accelerates() const { return jacobi && !plain_jacobi; }

  // Returns the momentum b of the next trial, which starts at u + b (u - before). `limit` is that of the Jacobi
  // schedule. `corrected`: the direction has the coarse correction. `waits`: the coarse
  // problem is not built yet, and until then a rotating part may hardly move. `held`: it includes contacts.
  PD_HD double propose(double limit, bool corrected, bool waits, bool held) {
    const bool extrapolates = accelerates() || !(learns || plain_jacobi);
    const double b = extrapolates ? extrapolation(jacobi ? limit : momentum_limit()) : 0;
    omega = plain_jacobi || jacobi ? 1 + b : 0;
    const double whole = corrected ? full(held) : waits ? 0 : rotating_share;
    share = {whole * material_fit * trial_length(), corrected ? coarse_kept : rotating_kept};
    return b;
  }

  PD_HD bool is_met(double tolerance, const Schedule& schedule, double change,
                    double displacement) {
    return stop.is_met(tolerance, omega > 0 ? schedule.error_share(omega) : share, change,
                       displacement);
  }

 private:
  PD_HD double reduction() const { return touches ? contact_step_reduction : step_reduction; }

  // Counts trials that fell short of the model E - t g.d + t^2 / 2 g.d; rounding can judge none.
  PD_HD void judge(double trial, double length) {
    const double promised = slope * length * (1 - 0.5 * length);
    if (!known || !(promised > slack * absolute(energy))) return;
    slow = energy - trial >= slow_share * promised ? 0 : slow + 1;
  }

  // the largest momentum with M
  PD_HD static double momentum_limit() {
    const double b = (1 - sqrt(1 - momentum_rho * momentum_rho)) / momentum_rho;
    return b * b;
  }

  PD_HD double extrapolation(double limit) {
    const double ramp = momentum / (momentum + 2.0);
    ++momentum;
    return ramp < limit ? ramp : limit;
  }

  PD_HD double full(bool held) const { return held && !friction ? contact_relaxation : 1; }

  // After a preconditioned trial of `length_taken`; `repeated`: not the first from its iterate.
  PD_HD void update_step_length(double length_taken, bool repeated) {
    if (accepted) {
      step_length = repeated ? MaterialMismatch::larger(length_taken, least_step_length)
                             : MaterialMismatch::smaller(1, length_taken / reduction());
      return;
    }
    ++reductions;
    const bool unsettled =
        friction && fallbacks < unsettled_fallbacks && failures >= unsettled_failures;
    if (reductions >= most_reductions || unsettled) start_fallback();
  }

  PD_HD void start_fallback() {
    fallback_left = friction ? friction_fallback_length
                             : fallback_length
                                   << (fallbacks < most_doublings ? fallbacks : most_doublings);
    ++fallbacks;
    jacobi = true;
    failures = reductions = 0;
  }
};

}  // namespace pd::inline PD_TARGET
