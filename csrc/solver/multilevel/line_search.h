// Globalisation of solver/multilevel/lbfgs.h for one environment, numbers only: accepts trials, and chooses the next step
// length and method. Trials that fail fall back on accelerated Jacobi iterations.
#pragma once
#include "math/scalar.h"
#include "solver/chebyshev.h"
#include "solver/multilevel/material_mismatch.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// iterations of the first Jacobi fallback, and of one with friction
constexpr int detour_length = 2, rough_detour_length = 8;
constexpr int most_doublings = 7;    // of these lengths
constexpr int patience = 4;          // failed trials before a fallback
constexpr double sufficient = 1e-4;  // share of the decrease that the slope predicts (Armijo)

// With contacts and a coarse problem trials are shortened:
constexpr double shortening = 0.25;   // factor of the step length after a failed trial
constexpr int forgetting = 2;         // failed trials before L-BFGS restarts
constexpr int most_shortenings = 12;  // before a fallback, which is 2, 4, 8, 16 iterations
constexpr int most_lengthenings = 3;
constexpr int rough_detours = 3,
              rough_patience = 2;  // with friction the first fallbacks come earlier
// share of the path of a step after which the coarse problem is rebuilt; that costs one or two iterations
constexpr double way_worth_making = 0.1;
constexpr double least_stride = 1e-8;

constexpr double momentum_rho = 0.9995;  // the radius of M A is unknown, and this limit serves all

// Estimated share of an error that a full step with M changes, if rotating parts have no coarse problem or M holds
// other vertices than the step. M is poorest there, and this is no bound. The error of an earlier trial decays over
// some trials: one that changes little may stand between two that change much.
constexpr double share_of_turns = 0.25;
constexpr double kept_by_turns = 0.5, kept_by_corotation = 0.25;

// Factor of theta while contacts without friction hold vertices. P M P has eigenvalues beyond 1 there for bending of
// a face, 4 for a cube of 15,625 vertices. If theta times them exceeds 2, one trial after another fails. A quarter
// would serve large faces better, and small ones worse.
constexpr double relaxed_on_contacts = 0.5;

// Relative rounding of E: a smaller rise has no meaning.
template <class T>
PD_HD constexpr double energy_noise() {
  return sizeof(T) == 4 ? 1e-5 : 1e-12;
}

// State of an environment: the current trial, and the outcome of those before.
struct Outer {
  double scale = 1;              // M / scale fits the material of the step
  double energy = 0, slope = 0;  // at the iterate; g.d of the direction there
  double slack = 0;
  int failures = 0, restarts = 0, momentum = 0;
  double fits = 1;  // least share of the error that M changes under material mismatch
  // of the current trial: its weight if it is a Jacobi iteration; else 0, and its error share
  double omega = 0;
  Share share;
  SoftStop stop;
  int detour = 0, doublings = 0;  // iterations left of a fallback; doublings of its length
  bool plain = false, accepted = true, known = false;
  bool friction = false;
  // accelerated Jacobi iterations: to the end of the step with momentum, during a fallback with L-BFGS
  bool diagonal = false;
  // whether trials are shortened; the step length without failures, the number of reductions, and the fallbacks of
  // the step
  bool searches = false;
  double stride = 1;
  int shortened = 0, detours = 0;
  // path length of accepted trials: in all, and since the coarse problem was built
  double walked = 0, strayed = 0;

  // step length of the next trial
  PD_HD double length() const {
    if (searches) {
      // the first failure at full length only teaches L-BFGS; the trial is repeated at full length
      double length = stride;
      for (int i = stride < 1 ? 0 : 1; i < failures; ++i) length *= shortening;
      return length;
    }
    const int halved =
        failures < patience ? failures - 1 : patience - 1;  // more failures end in a fallback
    return halved > 0 ? 1.0 / double(1 << halved) : 1.0;
  }

  // Weight of M in a step; `held`: the coarse problem includes contacts.
  PD_HD double weight(double relaxation, bool held) const {
    return full(held) * relaxation / scale;
  }

  // Whether a trial of this energy is accepted; `work` is the part against friction. NaN is not, unless it is the
  // first trial.
  PD_HD bool accept(double trial, double work, bool armijo) {
    const double took = length();
    const bool of_m = !plain && !diagonal;
    const double demanded = armijo && of_m ? sufficient * took * slope : 0;
    const bool fell = !known || trial <= energy - demanded + slack * absolute(energy);
    // friction has no energy: with it the Jacobi iteration is a fixed-point map, and continues
    accepted = fell || ((plain || diagonal) && friction && trial < HUGE_VAL);
    restarts += !fell;
    const bool again = failures > 0;
    failures = accepted ? 0 : failures + 1;
    if (!fell) momentum = 0;
    if (accepted) {
      known = true;
      // the friction of another iterate does other work
      energy = trial - work;
    }
    if (searches && !diagonal) {
      plain = false;
      if (of_m) search(took, again);
      return accepted;
    }
    if (searches) {
      diagonal = --detour > 0;
      // the momentum failed
      if (!diagonal) failures = 0;
    } else if (!armijo) {
      // without momentum M alone descends, if it fits
      diagonal = diagonal || failures > 1;
    } else if (!diagonal) {
      if (failures >= (friction ? 1 : patience)) {
        start_detour();
      } else if (fell && !friction && doublings > 0) {
        --doublings;
      }
    } else if (friction && !fell) {
      start_detour();
    } else if (fell) {
      // without friction only the momentum can fail here
      diagonal = --detour > 0;
    }
    plain = failures >= patience;
    return accepted;
  }

  // whether L-BFGS stores the pair of the last trial, and whether it clears all pairs
  PD_HD bool teaches() const { return !searches || accepted || (failures == 1 && stride >= 1); }
  PD_HD bool forgets() const { return plain || diagonal || (searches && failures == forgetting); }

  // `touches`: there are contacts; `corotates`: there is a coarse problem
  PD_HD void begin(const Misfit& misfit, bool touches, bool has_friction, bool corotates,
                   double noise, double fall) {
    *this = {};
    scale = misfit.scale;
    fits = misfit.spread < 1 ? 1 - misfit.spread : share_of_turns;
    friction = has_friction;
    searches = touches && corotates;
    slack = noise;
    stop.fall = fall;
  }

  // Adds an accepted trial to the path, from its squared change.
  PD_HD void walk(double change) {
    if (!accepted) return;
    walked += sqrt(change);
    strayed += sqrt(change);
  }
  // whether to rebuild the coarse problem: in a step with failures, after enough of its path
  PD_HD bool turns() const {
    return accepted && restarts > 0 && strayed > way_worth_making * walked;
  }

  // Whether the slope g.d of a direction is negative. If not, the secant pairs do not hold here.
  PD_HD bool descends(double along) {
    slope = along;
    if (slope >= 0 || plain || diagonal) return true;
    plain = true;
    ++restarts;
    return false;
  }

  // whether the next trial is an accelerated Jacobi iteration
  PD_HD bool accelerates() const { return diagonal && !plain; }

  // Returns the momentum b of the next trial, which starts at u + b (u - before). `limit` is that of the Jacobi
  // schedule; `learns` is true for L-BFGS. `corotated`: the direction has the coarse correction. `waits`: the coarse
  // problem is not built yet, and until then a rotating part may hardly move. `held`: it includes contacts.
  PD_HD double send(double limit, bool learns, bool corotated, bool waits, bool held) {
    const bool extrapolates = accelerates() || !(learns || plain);
    const double b = extrapolates ? extrapolation(diagonal ? limit : momentum_limit()) : 0;
    omega = plain || diagonal ? 1 + b : 0;
    const double whole = corotated ? full(held) : waits ? 0 : share_of_turns;
    share = {whole * fits * length(), corotated ? kept_by_corotation : kept_by_turns};
    return b;
  }

  PD_HD bool ends(double tolerance, const Schedule& schedule, double change, double way) {
    return stop.ends(tolerance, omega > 0 ? schedule.share_of(omega) : share, change, way);
  }

 private:
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

  PD_HD double full(bool held) const { return held && !friction ? relaxed_on_contacts : 1; }

  // After a preconditioned trial of `length_taken`; `repeated`: not the first from its iterate.
  PD_HD void search(double took, bool again) {
    if (accepted) {
      stride = again ? Misfit::larger(took, least_stride) : Misfit::smaller(1, took / shortening);
      return;
    }
    ++shortened;
    const bool unsettled = friction && detours < rough_detours && failures >= rough_patience;
    if (shortened >= most_shortenings || unsettled) start_detour();
  }

  PD_HD void start_detour() {
    detour = friction ? rough_detour_length : detour_length;
    if (searches) {
      if (!friction) detour <<= detours < most_lengthenings ? detours : most_lengthenings;
    } else {
      detour <<= doublings;
      doublings += doublings < most_doublings;
    }
    ++detours;
    diagonal = true;
    failures = shortened = 0;
  }
};

}  // namespace pd::inline PD_TARGET
