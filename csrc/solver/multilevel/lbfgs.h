// A step by preconditioned L-BFGS, or by momentum: M approximates A^-1 by levels, see plan/multilevel/build.h.
//
// E lies below a quadratic with the constant matrix A (solver/step.h). With M's reference material, 0 < M A <= 1 up
// to rounding. So u - theta M grad E with theta < 2 lowers E by at least theta (1 - theta / 2) g^T M g. For another
// material let s be the largest ratio of its inertias and stiffnesses to the reference. Then A <= s A_0, and theta M
// / s descends.
//
// L-BFGS and momentum may overshoot, so every trial is accepted or rejected by its energy. L-BFGS shortens rejected
// trials, and the next one starts as short; the pair of a rejected trial is not used, since it holds the curvature of
// motions too large. After twelve of a step accelerated Jacobi iterations replace M; they descend by the proof there.
// Their number is 2, then 4, 8, 16. With momentum they last for the rest of the step.
//
// Contacts block directions that A does not know of. M is applied to the residual along the free directions, and its
// result is used along them. The diagonal serves the blocked ones (two-metric projection, Bertsekas 1982), and
// vertices with a spring much stiffer than in M. Along the free directions M is far too soft for motions of whole
// parts, by the ratio of stiffness to inertia. The coarse space of solver/multilevel/pieces.h replaces these, with
// contacts included.
//
// Trials of a landing body fail because the direction is good until it moves a stiff face into a contact that is not
// active yet, and bends it there. A thousandth and less of it is left where a face hovers within micrometres. With
// friction Jacobi fallbacks come first, since unsettled normal forces drag stiff bodies far astray.
//
// Friction is Coulomb's with the normal force at the iterate. Within an iteration it has an energy, its bound times
// the slip, whose work enters the acceptance test. Its force along the slip is part of the residual. A trial ends
// where a slip ends, since friction does not reverse it (as in OWL-QN, Andrew and Gao 2007). Where friction resists
// the rotation of a slip more than the body does, M acts along the slip alone (contact/plane_sphere.h). New contacts of a
// trial have no friction before the next one.
#pragma once
#include "math/scalar.h"
#include "solver/multilevel/line_search.h"
#include "solver/multilevel/material_mismatch.h"
#include "solver/multilevel/v_cycle.h"
#include "solver/step.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The runner's own functions say whether this runs in a kernel or on the host.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void multilevel_step(Runner& run) {
  run.predict();
  run.start();
  run.align();
  run.minimise();  // multilevel_iterations
  run.align();
  run.finish();
}

#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void multilevel_iterations(Runner& run, const Settings& settings) {
  for (int k = 0;; ++k) {
    run.evaluate(k);          // local step at the trial: energy and residual
    run.accept_or_reject(k);  // accept the trial, or go back
    if (k == settings.iterations) break;
    run.update_pairs(k);  // secant pair of the trial
    if (run.finished()) break;
    // direction: M, corrected by the secant pairs
    if (!run.uses_jacobi()) run.precondition();
    run.next_trial();  // next trial, on the pins and out of the contacts
  }
  run.keep_best();  // the last accepted trial
}

constexpr int history = 8;                 // secant pairs that L-BFGS keeps
constexpr double least_curvature = 1e-12;  // least s.y of a pair, relative to |s| |y|

// L-BFGS (Nocedal 1980) in products of s and y, so that the vectors are read once before M and once after it. Pairs
// form a ring buffer, one place a trial; a pair without positive curvature is not used.
struct SecantPairs {
  double product[history][history] = {};  // s_i . y_j, j not older than i
  double inverse[history] = {};           // 1 / s_i . y_i
  double s_dot_g[history] = {};           // s_i . g
  double alpha[history] = {};
  bool valid[history] = {};  // the other arrays of an invalid pair may hold anything, NaN too

  PD_HD void clear() {
    for (bool& v : valid) v = false;
  }

  // Admits the pair at `newest`, whose products are stored, by its s.y, |s|^2 and |y|^2; `teaches`: it may be used.
  PD_HD void admit(int newest, bool teaches, double curvature, double ss, double yy) {
    inverse[newest] = 1 / curvature;
    const double least = least_curvature * least_curvature * ss * yy;
    valid[newest] =
        teaches && curvature > 0 && curvature * curvature > least && curvature < HUGE_VAL;
  }

  PD_HD static int older(int place, int by) { return (place - by + history) % history; }

  // M is applied to g - sum alpha_i y_i
  PD_HD void first_loop(int newest) {
    for (int a = 0; a < history; ++a) {
      const int i = older(newest, a);
      double rest = s_dot_g[i];
      for (int b = 0; b < a; ++b) {
        const int j = older(newest, b);
        if (valid[j]) rest -= alpha[j] * product[i][j];
      }
      alpha[i] = valid[i] ? rest * inverse[i] : 0;
    }
  }

  // slope g.d of the direction; `own` is that of z
  PD_HD double slope(double own, const double (&c)[history]) const {
    for (int i = 0; i < history; ++i) own += valid[i] ? c[i] * s_dot_g[i] : 0;
    return own;
  }

  // The direction is z + sum c_i s_i; `with` are y_i . z
  PD_HD void second_loop(int newest, const double (&with)[history], double (&c)[history]) const {
    for (int a = history - 1; a >= 0; --a) {
      const int i = older(newest, a);
      double rest = with[i];
      for (int b = history - 1; b > a; --b) {
        const int j = older(newest, b);
        if (valid[j]) rest += c[j] * product[j][i];
      }
      c[i] = valid[i] ? alpha[i] - rest * inverse[i] : 0;
    }
  }
};

}  // namespace pd::inline PD_TARGET
