// A step by preconditioned L-BFGS, or by momentum: M approximates A^-1 by levels, see plan/multilevel_build.h.
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
// to inertia; the small problem of solver/corotation.h takes those away and puts in what contacts make of them.
//
// With it trials of a body that lands fail for another reason: the direction is good until it takes a stiff face into a contact
// that holds nothing yet, and bends it there. So they are shortened, to a thousandth and less where a face hovers within
// micrometres, and the next one begins as short. Detours, never long, come where that fails, too, and with friction at first:
// normal forces that have not settled drag stiff bodies far astray.
//
// Friction is that of Coulomb with the normal force of the base, so that within an iteration it has an energy, its bound times
// the slip. Its force along the slip is part of what is out of balance; its work is part of the judgement; a trial goes no
// further than to where a slip ends, since friction does not turn it round (as in OWL-QN, Andrew and Gao 2007); and where it
// holds the direction of a slip harder than the body does, M is left the direction alone (effects/contact.h). Contacts that a
// trial finds have no friction before the next one.
#pragma once
#include "math/chebyshev.h"
#include "math/scalar.h"
#include "plan/views.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// The runner's own functions say where it runs: in a kernel, or on the host.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void multilevel_step(Runner& run, const Settings& settings) {
  run.predict();
  if (settings.report) run.measure_course();
  run.start();
  run.align();
  run.descend();  // multilevel_iterations
  run.align();
  if (settings.report) run.measure();
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

// ---- M: a symmetric V-cycle, or A^-1 where the plan says so (Levels::direct)
//
// With S that smooths before and after, a prolongation P and B in place of the matrix below, a cycle is
//   S r + S (r - A S r) + (I - S A) P B P^T (I - A S) r.
// Its first two terms know nothing of the level below, so with F = (I - S A) P as lifts they are worked out meanwhile: what a GPU
// does, where a cycle is as long as the phases that wait for one another (cuda/cycle.h). The CPU goes down and up, with P.

// Chebyshev's polynomial of degree 2 for eigenvalues of D^-1 A in [1/4, 1], from zero (Saad 2003, algorithm 12.1):
//   w = first / D r,   z = keep w + second / D (r - A w)
struct Smoother {
  static constexpr double middle = 0.625, half = 0.375;
  static constexpr double ratio = half / middle, next = 1 / (2 / ratio - ratio);
  static constexpr double first = 1 / middle, keep = 1 + next * ratio, second = 2 * next / half;
};

// A matrix level with B unknowns a row and axis, and how it is lifted from four functions of each node below.
template <int B, class T>
struct Level {
  int rows, nodes;
  const int32 *start, *column;
  const T *value, *inverse;
  const int32 *lift_start, *lift_node;
  const T* lift_weight;
  const int32 *node_start, *node_row, *node_lift;
  const T* node_weight;
};

template <class T>
PD_HD Level<1, T> fine_level(const Levels<T>& l) {
  return {l.vertices,         l.fine_nodes,      l.fine_start,      l.fine_column,
          l.fine_value,       l.fine_inverse,    l.fine_lift_start, l.fine_lift_node,
          l.fine_lift_weight, l.fine_node_start, l.fine_node_row,   l.fine_node_lift,
          l.fine_node_weight};
}

template <class T>
PD_HD Level<4, T> middle_level(const Levels<T>& l) {
  return {l.fine_nodes,         l.middle_nodes,      l.middle_start,      l.middle_column,
          l.middle_value,       l.middle_inverse,    l.middle_lift_start, l.middle_lift_node,
          l.middle_lift_weight, l.middle_node_start, l.middle_node_row,   l.middle_node_lift,
          l.middle_node_weight};
}

// Sums of a row in turn, because each waits for its own last addition; they are added up last.
constexpr int row_chains = 4;

template <class Value>
PD_HD Value join(const Value (&sum)[row_chains]) {
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

// A x, one row of numbers: number p of it goes to chain p mod 4. One environment and several get the same bits.
template <class Real, class T, class Value>
PD_HD Value row_product(const Level<1, T>& level, const Value* x, int row) {
  const int32 end = level.start[row + 1];
  int32 p = level.start[row];
  Value sum[row_chains] = {};
  const auto add = [&](int c, int32 at, T a) {
    sum[c] = multiply_add(Real(a), x[level.column[at]], sum[c]);
  };
  for (; p + row_chains < end; p += row_chains) {
    for (int c = 0; c < row_chains; ++c) add(c, p + c, level.value[p + c]);
  }
  constexpr bool several = sizeof(Real) > sizeof(T);
  if constexpr (several) {
    for (int c = 0; p + c < end; ++c) add(c, p + c, level.value[p + c]);
  } else if (p < end) {
    // always four steps, because branches on what is left are mispredicted; zeros change no finite sum
    for (int c = 0; c < row_chains; ++c) {
      const int32 at = p + c < end ? p + c : end - 1;
      add(c, at, p + c < end ? level.value[at] : T(0));
    }
  }
  return join(sum);
}

// sum -= A x, one row
template <class Real, class T, class Value>
PD_HD void subtract_row(const Level<1, T>& level, const Value* x, int row, Value (&sum)[1]) {
  sum[0] = sum[0] - row_product<Real>(level, x, row);
}
template <class Real, int B, class T, class Value>
PD_HD void subtract_row(const Level<B, T>& level, const Value* x, int row, Value (&sum)[B]) {
  for (int32 p = level.start[row]; p < level.start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.column[p]) * B;
    const T* a = level.value + std::int64_t(p) * B * B;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < B; ++j) sum[i] = subtract_product(sum[i], Real(a[i * B + j]), from[j]);
    }
  }
}

// sum += P x, one row
template <class Real, int B, class T, class Value>
PD_HD void add_lift(const Level<B, T>& level, const Value* x, int row, Value (&sum)[B]) {
  for (int32 p = level.lift_start[row]; p < level.lift_start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.lift_node[p]) * 4;
    const T* weight = level.lift_weight + std::int64_t(p) * B * 4;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < 4; ++j) sum[i] = multiply_add(Real(weight[i * 4 + j]), from[j], sum[i]);
    }
  }
}
template <class Real, class T, class Value>
PD_HD void add_lift(const Level<1, T>& level, const Value* x, int row, Value (&sum)[1]) {
  Value part[row_chains] = {};
  for (int32 p = level.lift_start[row]; p < level.lift_start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.lift_node[p]) * 4;
    const T* weight = level.lift_weight + std::int64_t(p) * 4;
    for (int j = 0; j < 4; ++j) part[j] = multiply_add(Real(weight[j]), from[j], part[j]);
  }
  sum[0] = sum[0] + join(part);
}

// sum += P^T x, the four functions of one node
template <class Real, int B, class T, class Value>
PD_HD void add_restriction(const Level<B, T>& level, const Value* x, int node, Value (&sum)[4]) {
  for (int32 p = level.node_start[node]; p < level.node_start[node + 1]; ++p) {
    const Value* from = x + std::int64_t(level.node_row[p]) * B;
    const T* weight = level.lift_weight + std::int64_t(level.node_lift[p]) * B * 4;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < 4; ++j) sum[j] = multiply_add(Real(weight[i * 4 + j]), from[i], sum[j]);
    }
  }
}

// ---- how far the material of a step is from that which M was made of

// Ratios of one to the other.
struct Range {
  double least = HUGE_VAL, largest = 0;

  PD_HD void count(double ratio) { add({ratio, ratio}); }

  PD_HD void add(const Range& other) {
    least = other.least < least ? other.least : least;
    largest = other.largest > largest ? other.largest : largest;
  }
};

constexpr double known_inertia =
    4;  // times what M was made of and the elements have become: more is left to the diagonal

struct Misfit {
  double scale = 1;        // s of A <= s A_0, strangers aside
  double spread = 0;       // 1 - q / s, q A_0 <= A <= s A_0 with them
  double trusted = 1;      // ratio of inertias up to known_inertia times which M is believed
  bool strangers = false;  // whether there are vertices beyond, or that M alone holds

  Misfit() = default;

  PD_HD Misfit(const Range& elements, const Range& inertias)
      : trusted(larger(elements.largest, smaller(inertias.least, inertias.largest))),
        strangers(inertias.largest > known_inertia * trusted) {}

  // `common`: the inertias that are no strangers'; `other_pins`: the step holds other vertices than M does
  PD_HD void conclude(const Range& elements, const Range& inertias, const Range& common,
                      bool other_pins) {
    scale = larger(elements.largest, common.largest);
    const double least = smaller(elements.least, common.least);
    spread = other_pins ? 1 : 1 - least / larger(elements.largest, inertias.largest);
    strangers = strangers || other_pins;
  }

  PD_HD static double larger(double a, double b) { return a < b ? b : a; }
  PD_HD static double smaller(double a, double b) { return b < a ? b : a; }
};

// ---- the outer iteration of one environment: numbers only

constexpr int history = 8;  // pairs that L-BFGS remembers
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

constexpr double least_curvature = 1e-12;  // s.y of a pair, in |s| |y|
constexpr double momentum_rho = 0.9995;    // that of M A is not known, and this limit serves all

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

  // Whether to go on from a trial of this energy. False for NaN, unless there is nothing to go back to.
  PD_HD bool accept(double trial, bool armijo) {
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
      energy = trial;
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

  // Of the trial that goes out next, with momentum b, by a direction that has the small problem's part or not; `waits`: that is
  // still to be made, and until then a part that turns may hardly move at all; `held`: it has contacts in it.
  PD_HD void send(double b, bool corotated, bool waits, bool held) {
    omega = plain || diagonal ? 1 + b : 0;
    const double whole = corotated ? full(held) : waits ? 0 : share_of_turns;
    share = {whole * fits * length(), corotated ? kept_by_corotation : kept_by_turns};
  }

  PD_HD bool ends(double tolerance, const Schedule& schedule, double change, double way) {
    return stop.ends(tolerance, omega > 0 ? schedule.share_of(omega) : share, change, way);
  }

  // the most that momentum with M takes
  PD_HD static double momentum_limit() {
    const double b = (1 - sqrt(1 - momentum_rho * momentum_rho)) / momentum_rho;
    return b * b;
  }

  // beta of u + beta (u - before)
  PD_HD double extrapolation(double limit) {
    const double ramp = momentum / (momentum + 2.0);
    ++momentum;
    return ramp < limit ? ramp : limit;
  }

 private:
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

  // the pair in place `newest`: s_i . y of it with every s_i, |s|^2 and |y|^2
  PD_HD void add(int newest, const double (&with)[history], double ss, double yy) {
    for (int i = 0; i < history; ++i) product[i][newest] = with[i];
    admit(newest, with[newest], ss, yy);
  }

  // the same when the products are there, s.y of the pair among them
  PD_HD void admit(int newest, double curvature, double ss, double yy) {
    inverse[newest] = 1 / curvature;
    const double least = least_curvature * least_curvature * ss * yy;
    valid[newest] = curvature > 0 && curvature * curvature > least && curvature < HUGE_VAL;
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
