// One time step of implicit Euler by projective dynamics, as an algorithm. A runner supplies the loops.
//
//   E(u) = sum_i a_i / 2 |u_i - s_i|^2 + sum_e w_e V_e / 2 |F_e(x + u) - R_e|^2        u: displacement since the step's start
//
// Why it cannot diverge. R_e maximises tr(R^T F_e), so for any fixed rotations Q_e the quadratic
// q(u) = sum a/2 |u - s|^2 + sum w V / 2 |F_e - Q_e|^2 lies above E and touches it where Q_e = R_e(u). Its matrix is the
// constant A. With K_e = grad N grad N^T and l_e = lambda_max(diag(K_e)^-1/2 K_e diag(K_e)^-1/2): K_e <= l_e diag(K_e), so
// A <= D = diag(a_i + sum_e l_e w_e V_e |grad N_i|^2). Hence E(u - theta D^-1 g) <= E(u) - theta (1 - theta/2) g^T D^-1 g:
// no step with 0 < theta < 2 and omega = 1 raises E, for any mesh, state, stiffness and time step, inverted elements
// included. Projection onto one plane keeps this, since D is one number a vertex;
// several contacts of a vertex are projected on one after another, and a ball acts as a plane within an iteration.
#pragma once
#include "math/config.h"
#include "math/scalar.h"
#include "math/vec.h"
#include "solver/chebyshev.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The soft stop of an environment: whether the error that is left, by the changes of iterations, is within a tolerance of the way
// |u - s| from the targets: what elasticity and contacts have done, the same however fast all vertices move together.
struct SoftStop {
  double fall =
      0;  // square_of_fall; the way counts as no less, or free fall would compare rounding with rounding
  double left = 0;  // of the error

  // By the squares of the last change and of the way; where one overflows it goes on. Share {0, ..}: the change says nothing.
  PD_HD bool ends(double tolerance, const Share& share, double change, double way) {
    if (!(share.changed > 0)) return false;
    const double shown = sqrt(change) / share.changed, before = share.kept * left;
    left = shown < before ? before : shown;
    way = way < fall ? fall : way;
    return tolerance > 0 && way < HUGE_VAL && left <= tolerance * sqrt(way);
  }
};

// Square of the way that gravity takes so many vertices in a step.
template <class R>
PD_HD double square_of_fall(int vertices, double time_step, const Vec3<R>& gravity) {
  const double way = time_step * time_step;
  const double x = way * double(gravity.x), y = way * double(gravity.y),
               z = way * double(gravity.z);
  return vertices * (x * x + y * y + z * z);
}

// The runner's own functions say where it runs: in a kernel, or on the host.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void step(Runner& run, const Settings& settings) {
  run.predict();  // targets s: where inertia, forces and springs would take each vertex
  run.start();    // first iterate, on the pins and out of the contacts
  run.align();    // pieces that pins leave loose: exact along rigid motions
  for (int k = 0; k < settings.iterations; ++k) {
    // local step on every element, then one Jacobi iteration on every vertex, accelerated and projected
    run.iterate(k);
    if (run.finished()) break;
  }
  run.align();
  run.finish();  // new positions and velocities
}

}  // namespace pd::inline PD_TARGET
