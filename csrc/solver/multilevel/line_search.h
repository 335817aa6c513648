// The outer iteration of solver/multilevel/lbfgs.h for one environment, numbers only: which trial comes next, and what becomes of it.
#pragma once
#include "math/scalar.h"
#include "solver/chebyshev.h"
#include "solver/multilevel/material_mismatch.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// accelerated Jacobi iterations in place of L-BFGS the first time, and with friction
constexpr int detour_length = 2, rough_detour_length = 8;
constexpr int most_doublings = 7;    // of these lengths
constexpr int patience = 4;          // failed trials before them
constexpr double sufficient = 1e-4;  // of the decrease that the slope promises (Armijo)

// Where contacts may hold a body that has a small problem:
constexpr double shortening = 0.25;   // of a trial for each that failed before it
constexpr int forgetting = 2;         // failed trials after which L-BFGS begins anew
constexpr int most_shortenings = 12;  // before a detour, which is two, four, eight, 16 iterations
constexpr int most_lengthenings = 3;
constexpr int rough_detours = 3, rough_patience = 2;  // with friction the first come so early
// of the way of a step: beyond it the small problem is made anew, which costs one or two iterations
constexpr double way_worth_making = 0.1;
constexpr double least_stride = 1e-8;

constexpr double momentum_rho = 0.9995;  // that of M A is not known, and this limit serves all

// About the share of an error that a full step with M changes where turning parts have no small problem, of which M knows
// least, or where M holds other vertices than the step: no bound. What an earlier trial showed counts on for some trials, as
// one that changes little may stand between two that change much.
constexpr double share_of_turns = 0.25;
constexpr double kept_by_turns = 0.5, kept_by_corotation = 0.25;

// Of theta, while contacts without friction hold vertices. There P M P has eigenvalues beyond 1 for the ways in which a face
// bends: 4 for a cube of 15,625 vertices, and theta times them, if more than 2, fails one trial after another. A quarter would
// serve large faces better, and small ones worse.
constexpr double relaxed_on_contacts = 0.5;

// Rounding of E, relative: a rise that says nothing.
template <class T>
PD_HD constexpr double energy_noise() {
  return sizeof(T) == 4 ? 1e-5 : 1e-12;
}

// Where an environment stands: which trial is out, and what became of those before.
struct Outer {
  double scale = 1;              // M / scale serves the material of the step
  double energy = 0, slope = 0;  // at the base; g.d of the direction from there
  double slack = 0;
  int failures = 0, restarts = 0, momentum = 0;
  double fits = 1;  // least share of the error that M changes for being of another material
  // of the trial that is out: its weight where 1 / D makes it, else 0 and what its change says of the error
  double omega = 0;
  Share share;
  SoftStop stop;
  int detour = 0, doublings = 0;  // iterations left of a detour; how long the next one is
  bool plain = false, accepted = true, known = false;
  bool friction = false;
  // momentum with 1 / D in place of M: to the end of the step, of L-BFGS while a detour lasts
  bool diagonal = false;
  // whether trials are shortened; how long one is that no failure shortens, how many were, and detours of the step
  bool searches = false;
  double stride = 1;
  int shortened = 0, detours = 0;
  // how far accepted trials have led, in all and since the small problem was made
  double walked = 0, strayed = 0;

  // how much of the direction the next trial takes
  PD_HD double length() const {
    if (searches) {
      // like elsewhere the first that fails at full length has taught enough to try again
      double length = stride;
      for (int i = stride < 1 ? 0 : 1; i < failures; ++i) length *= shortening;
      return length;
    }
    const int halved =
        failures < patience ? failures - 1 : patience - 1;  // what more fail goes another way
    return halved > 0 ? 1.0 / double(1 << halved) : 1.0;
  }

  // Of M in a step; `held`: the small problem has contacts in it.
  PD_HD double weight(double relaxation, bool held) const {
    return full(held) * relaxation / scale;
  }

  // Whether to go on from a trial of this energy, of which `work` is that against friction. False for NaN, unless there is
  // nothing to go back to.
  PD_HD bool accept(double trial, double work, bool armijo) {
    const double took = length();
    const bool of_m = !plain && !diagonal;
    const double demanded = armijo && of_m ? sufficient * took * slope : 0;
    const bool fell = !known || trial <= energy - demanded + slack * absolute(energy);
    // friction has no energy: there the plain iteration is a fixed-point map, and goes on regardless
    accepted = fell || ((plain || diagonal) && friction && trial < HUGE_VAL);
    restarts += !fell;
    const bool again = failures > 0;
    failures = accepted ? 0 : failures + 1;
    if (!fell) momentum = 0;
    if (accepted) {
      known = true;
      // the friction of another base does other work
      energy = trial - work;
    }
    if (searches && !diagonal) {
      plain = false;
      if (of_m) search(took, again);
      return accepted;
    }
    if (searches) {
      diagonal = --detour > 0;
      // what failed was momentum
      if (!diagonal) failures = 0;
    } else if (!armijo) {
      // with the momentum gone M alone descends, if it fits
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
      // what fails here without friction is momentum
      diagonal = --detour > 0;
    }
    plain = failures >= patience;
    return accepted;
  }

  // whether L-BFGS is to know the way to the last trial, and to forget what it knew before
  PD_HD bool teaches() const { return !searches || accepted || (failures == 1 && stride >= 1); }
  PD_HD bool forgets() const { return plain || diagonal || (searches && failures == forgetting); }

  // `touches`: there are contacts; `corotates`: there is a small problem
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

  // By a trial that changes so much, squared.
  PD_HD void walk(double change) {
    if (!accepted) return;
    walked += sqrt(change);
    strayed += sqrt(change);
  }
  // whether the small problem is to be made anew: in a step that has failed, where it led on since
  PD_HD bool turns() const {
    return accepted && restarts > 0 && strayed > way_worth_making * walked;
  }

  // Whether the slope g.d says that a direction leads downhill. If not, what was learnt does not hold here.
  PD_HD bool descends(double along) {
    slope = along;
    if (slope >= 0 || plain || diagonal) return true;
    plain = true;
    ++restarts;
    return false;
  }

  // whether the next trial is an accelerated Jacobi iteration
  PD_HD bool accelerates() const { return diagonal && !plain; }

  // Returns momentum b of the trial that goes out next, of which u + b (u - before) is the start; `limit`: of the schedule of
  // Jacobi iterations; `learns`: by L-BFGS; `corotated`: its direction has the small problem's part; `waits`: that is still to
  // be made, and until then a part that turns may hardly move at all; `held`: it has contacts in it.
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
  // the most that momentum with M takes
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

  // After a trial of M that `took` that much, and was not the first of its base: `again`.
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
