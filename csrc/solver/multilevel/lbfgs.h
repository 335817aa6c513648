// A step by preconditioned L-BFGS, or by momentum: M approximates A^-1 by levels, see plan/multilevel/build.h.
//
// E lies below a quadratic with the constant matrix A (solver/step.h). With the material that M was made for, 0 < M A <= 1 up
// to rounding, so u - theta M grad E with theta < 2 lowers E by at least theta (1 - theta / 2) g^T M g. With another one,
// A <= s A_0 for the largest ratio s of its inertias and stiffnesses to those M was made for: theta M / s does.
// What accelerates that step may overshoot, so every trial is judged by its energy before the next one starts from it.
// Trials that fail go back, and after a few of them Jacobi iterations take over, which descend by the proof there, accelerated:
// for a while with L-BFGS, which has learnt from the failures, and for the rest of the step with momentum, which has not. A while
// is two iterations, then four, eight, and shorter again where M serves; with friction, unless there is the small problem below,
// eight, then sixteen, after a single failure.
//
// Contacts hold vertices in directions that A does not know of. M is applied to what is out of balance in the others, and its
// result taken in the others, while the held ones go by the diagonal (two-metric projection, Bertsekas 1982), as does a vertex
// that a spring holds much harder than M knows. In them M is far too soft for motions of whole parts, by the ratio of stiffness
// to inertia; the small problem of solver/multilevel/deflation.h takes those away and puts in what contacts make of them.
//
// With it trials of a body that lands fail for another reason: the direction is good until it takes a stiff face into a contact
// that holds nothing yet, and bends it there. So they are shortened, to a thousandth and less where a face hovers within
// micrometres, and the next one begins as short. Detours, never long, come where that fails, too, and with friction at first:
// normal forces that have not settled drag stiff bodies far astray.
//
// Friction is that of Coulomb with the normal force of the base, so that within an iteration it has an energy, its bound times
// the slip. Its force along the slip is part of what is out of balance; its work is part of the judgement; a trial goes no
// further than to where a slip ends, since friction does not turn it round (as in OWL-QN, Andrew and Gao 2007); and where it
// holds the direction of a slip harder than the body does, M is left the direction alone (contact/plane_sphere.h). Contacts that a
// trial finds have no friction before the next one.
#pragma once
#include "math/scalar.h"
#include "solver/multilevel/line_search.h"
#include "solver/multilevel/material_mismatch.h"
#include "solver/multilevel/v_cycle.h"
#include "solver/step.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The runner's own functions say where it runs: in a kernel, or on the host.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void multilevel_step(Runner& run) {
  run.predict();
  run.start();
  run.align();
  run.descend();  // multilevel_iterations
  run.align();
  run.finish();
}

#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void multilevel_iterations(Runner& run, const Settings& settings) {
  for (int k = 0;; ++k) {
    run.evaluate(k);  // local step at the trial: its energy, and what is out of balance there
    run.judge(k);     // go on from the trial, or back
    if (k == settings.iterations) break;
    run.learn(k);  // what the way to it says about the curvature
    if (run.finished()) break;
    // direction: M, corrected by what was learnt
    if (!run.goes_by_diagonal()) run.precondition();
    run.advance();  // next trial, on the pins and out of the contacts
  }
  run.settle();  // on the last trial that was better
}

constexpr int history = 8;                 // pairs that L-BFGS remembers
constexpr double least_curvature = 1e-12;  // s.y of a pair, in |s| |y|

// L-BFGS (Nocedal 1980) with all that it needs of s and y as numbers, so that the vectors are read once before M and once
// after it. Pairs stand in a ring, one place a trial; a pair without positive curvature stays out.
struct Pairs {
  double product[history][history] = {};  // s_i . y_j, j not older than i
  double inverse[history] = {};           // 1 / s_i . y_i
  double pulled[history] = {};            // s_i . g
  double alpha[history] = {};
  bool valid[history] =
      {};  // what a pair that is not has in the other arrays may be anything, NaN too

  PD_HD void clear() {
    for (bool& v : valid) v = false;
  }

  // The pair in place `newest`, by |s|^2 and |y|^2, once its products are there; `teaches`: it may count.
  PD_HD void admit(int newest, bool teaches, double ss, double yy) {
    const double curvature = product[newest][newest];
    inverse[newest] = 1 / curvature;
    const double least = least_curvature * least_curvature * ss * yy;
    valid[newest] =
        teaches && curvature > 0 && curvature * curvature > least && curvature < HUGE_VAL;
  }

  PD_HD static int older(int place, int by) { return (place - by + history) % history; }

  // g - sum alpha_i y_i is what M is applied to
  PD_HD void first_loop(int newest) {
    for (int a = 0; a < history; ++a) {
      const int i = older(newest, a);
      double rest = pulled[i];
      for (int b = 0; b < a; ++b) {
        const int j = older(newest, b);
        if (valid[j]) rest -= alpha[j] * product[i][j];
      }
      alpha[i] = valid[i] ? rest * inverse[i] : 0;
    }
  }

  // g.d of the direction, `own` being that of z
  PD_HD double slope(double own, const double (&c)[history]) const {
    for (int i = 0; i < history; ++i) own += valid[i] ? c[i] * pulled[i] : 0;
    return own;
  }

  // z + sum c_i s_i is the direction; `with` are y_i . z
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
