// One time step of implicit Euler by projective dynamics, as an algorithm. A runner supplies the loops.
//
//   E(u) = sum_i a_i / 2 |u_i - s_i|^2 + sum_e w_e V_e / 2 |F_e(x + u) - R_e|^2        u: displacement since the step's start
//
// Why it cannot diverge. R_e maximises tr(R^T F_e). So for any fixed rotations Q_e the quadratic q(u) = sum a/2 |u -
// s|^2 + sum w V / 2 |F_e - Q_e|^2 lies above E and touches it where Q_e = R_e(u). Its matrix is the constant A. With
// K_e = grad N grad N^T and l_e = lambda_max(diag(K_e)^-1/2 K_e diag(K_e)^-1/2): K_e <= l_e diag(K_e), so A <= D =
// diag(a_i + sum_e l_e w_e V_e |grad N_i|^2). Hence E(u - theta D^-1 g) <= E(u) - theta (1 - theta/2) g^T D^-1 g. So
// no step with 0 < theta < 2 and omega = 1 raises E, for any mesh, state, stiffness and time step, inverted elements
// included. Projection onto one plane keeps this, since D is one number a vertex. Several contacts of a vertex are
// projected on one after another, and a sphere acts as a plane within an iteration.
#pragma once
#include "math/config.h"
#include "math/scalar.h"
#include "math/vec.h"
#include "solver/chebyshev.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The stopping test of an environment: whether the estimated error is within the tolerance, relative to |u - s|. That
// is the displacement which elasticity and contacts cause; a common motion of all vertices does not change it.
struct StoppingTest {
  double free_fall =
      0;  // squared_free_fall: lower bound of |u - s|^2, so that free fall does not compare roundings
  double error = 0;  // estimated error

  // Takes the squares of the last change and of |u - s|; an overflow goes on. With share.changed = 0 a change says
  // nothing.
  PD_HD bool is_met(double tolerance, const ErrorShare& share, double change, double displacement) {
    if (!(share.changed > 0)) return false;
    const double from_change = sqrt(change) / share.changed, remaining = share.kept * error;
    error = from_change < remaining ? remaining : from_change;
    displacement = displacement < free_fall ? free_fall : displacement;
    return tolerance > 0 && displacement < HUGE_VAL && error <= tolerance * sqrt(displacement);
  }
};

// Square of the displacement by gravity in one step, summed over so many vertices.
template <class R>
PD_HD double squared_free_fall(int vertices, double time_step, const Vec3<R>& gravity) {
  const double h2 = time_step * time_step;
  const double x = h2 * double(gravity.x), y = h2 * double(gravity.y), z = h2 * double(gravity.z);
  return vertices * (x * x + y * y + z * z);
}

// The runner's own functions say whether this runs in a kernel or on the host.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner>
PD_HD void step(Runner& run, const Settings& settings) {
  run.predict();  // targets s: where inertia, forces and springs would take each vertex
  run.start();    // first iterate, on the pins and out of the contacts
  run.align();    // coarse correction: rigid motions of components that pins leave free
  for (int k = 0; k < settings.iterations; ++k) {
    // local step on every element, then one Jacobi iteration on every vertex, accelerated and projected
    run.iterate(k);
    if (run.finished()) break;
  }
  run.align();
  run.finish();  // new positions and velocities
}

}  // namespace pd::inline PD_TARGET
