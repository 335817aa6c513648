// A stencil: n vertices with constant vectors g_a in R^d that add up to zero, and an energy of F.
//
//   F = sum_a x_a (x) g_a   (3 x d),   E = V psi(F),   dE/dx_a = V P g_a,   P = dpsi/dF
//
// psi is mu |F|^2 + kappa(h(F)), h the largest tr(Q^T F) over a set of Q, with kappa' <= 0 and kappa'' <= k. Then the
// diagonal of V |g_a|^2 (2 mu l_e + n k) majorises E everywhere, l_e as in solver/step.h: (h' - h)^2 <= n sum_a |g_a|^2
// |d_a|^2 for displacements d, and convexity of h bounds the rest.
//
// A kind is a struct:
//   corners, dims, constants, rows, numbers    n, d, stored constants, arrays of the material, numbers of a step
//   parameters(row, V, p)        numbers p of a step from the rows of the material; energies are scaled by V
//   stress<Energy>(f, p, c, P, energy)         V P, and adds V psi to `energy`; c: constants
//   weight(p, l, n)              V (2 mu l + n k); with l = n = 1 the stiffness at rest, for preconditioners
//   rest_weight(p)               that stiffness where it is another one
//   quadratic                    so many of its arrays, the first ones, make the energy p[0] / 2 |F|^2 with the weight
//                                p[0] l_e, where the scene lacks the others; d = 1
// Second derivatives and derivatives by the material follow from `stress` with dual numbers. A kind whose stress has no
// derivative in dual numbers has its own
//   hessian(f, df, p, c, dp)     dP along dF
// A kind may have the positive part of its second derivative in closed form
//   positive_hessian(f, p, s)    s: [3 d][3 d], see cpu/multilevel/stencil_hessians.h
// A kind may depend on the start of the step:
//   memory                       how many of the numbers p, the last ones, `begin` makes
//   begin(f, m)                  them, from F at the start
//   memory_slope(f, df, p, c, s) derivative of V P : dF by them
//   begin_slope(f, s, P)         s times the derivative of m by F at the start
//   dissipates                   true: psi is an energy times time, which a step divides by h; no elastic energy
// and
//   large                        true: it takes many registers. On a GPU only the kernels of cuda/poisson have it
// A kind may keep a history from step to step, its last array of the material, which no simulator trains:
//   history                      how many numbers
//   finish(f, row, h, next)      the next history, from F at the end of a step of h; with dual numbers its derivative
// Where psi is an energy of F A with a matrix A that the numbers p give, as after plastic flow, d = 3:
//   keeps_axes                   true: the vectors g_a are stored in the axes of the rest shape
//   metric(p)                    A; the majoriser then has A^T g_a in place of g_a
// A kind that stands for a whole tetrahedron has
//   inverts                      true: det F <= 0 counts as inverted
#pragma once
#include "math/dual.h"
#include "math/stretch.h"
#include "math/vec.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

template <class Kind>
constexpr bool keeps_axes = false;
template <class Kind>
  requires requires { Kind::keeps_axes; }
constexpr bool keeps_axes<Kind> = Kind::keeps_axes;

// Edges x_a - x_0 that make up column j of F. A rotation of R^d, which changes no energy, leaves the first n - d + j
// alone.
template <class Kind>
PD_HD constexpr int column_edges(int j) {
  return Kind::corners - (keeps_axes<Kind> ? 1 : Kind::dims - j);
}
// Numbers that store the vectors g_a.
template <class Kind>
constexpr int gradient_numbers = keeps_axes<Kind> ? Kind::dims * (Kind::corners - 1)
                                                  : Kind::dims * (Kind::corners - Kind::dims) +
                                                        Kind::dims * (Kind::dims - 1) / 2;
template <class Kind>
constexpr int stored_numbers = gradient_numbers<Kind> + Kind::constants;
// an array may not be empty
template <class Kind>
constexpr int constant_slots = Kind::constants > 0 ? Kind::constants : 1;

template <class Kind>
constexpr int memory_of = 0;
template <class Kind>
  requires requires { Kind::memory; }
constexpr int memory_of<Kind> = Kind::memory;
// arrays that make a quadratic energy; 0: none do
template <class Kind>
constexpr int quadratic_arrays = 0;
template <class Kind>
  requires requires { Kind::quadratic; }
constexpr int quadratic_arrays<Kind> = Kind::quadratic;

template <class Kind>
constexpr bool dissipates = false;
template <class Kind>
  requires requires { Kind::dissipates; }
constexpr bool dissipates<Kind> = Kind::dissipates;
template <class Kind>
constexpr int history_of = 0;
template <class Kind>
  requires requires { Kind::history; }
constexpr int history_of<Kind> = Kind::history;
template <class Kind>
constexpr bool inverts = false;
template <class Kind>
  requires requires { Kind::inverts; }
constexpr bool inverts<Kind> = Kind::inverts;

template <class Kind>
constexpr bool is_large = false;
template <class Kind>
  requires requires { Kind::large; }
constexpr bool is_large<Kind> = Kind::large;

// The stiffness at rest, which preconditioners are made of.
template <class Kind, class R>
PD_HD R rest_weight(const R (&p)[Kind::numbers]) {
  const R one(scalar_of<R>(1));
  if constexpr (requires { Kind::rest_weight(p); }) {
    return Kind::rest_weight(p);
  } else {
    return Kind::weight(p, one, one);
  }
}

// F, column by column
template <class Kind, class R, class Stored>
PD_HD void deform(const Vec3<R> (&x)[Kind::corners], const Stored& g, Vec3<R> (&f)[Kind::dims]) {
  constexpr int n = Kind::corners, d = Kind::dims;
  Vec3<R> edge[n - 1];
  for (int a = 0; a < n - 1; ++a) edge[a] = x[a + 1] - x[0];
  int at = 0;
  for (int j = 0; j < d; ++j) {
    for (int a = 0; a < column_edges<Kind>(j); ++a, ++at)
      f[j] = a == 0 ? R(g[at]) * edge[a] : multiply_add(R(g[at]), edge[a], f[j]);
  }
}

// P g_a of every corner
template <class Kind, class R, class Stored>
PD_HD void stencil_forces(const Vec3<R> (&p)[Kind::dims], const Stored& g,
                          Vec3<R> (&force)[Kind::corners]) {
  constexpr int n = Kind::corners, d = Kind::dims;
  int at = 0;
  for (int j = 0; j < d; ++j) {
    for (int a = 0; a < column_edges<Kind>(j); ++a, ++at) {
      const bool first = j == 0 || (!keeps_axes<Kind> && a == column_edges<Kind>(j) - 1);
      force[a + 1] = first ? R(g[at]) * p[j] : multiply_add(R(g[at]), p[j], force[a + 1]);
    }
  }
  Vec3<R> sum = force[1];
  for (int a = 2; a < n; ++a) sum = sum + force[a];
  force[0] = -sum;
}

// |g_a|^2 of every corner
template <class Kind, class R>
PD_HD void gradient_squares(const R (&g)[gradient_numbers<Kind>], R (&square)[Kind::corners]) {
  constexpr int n = Kind::corners, d = Kind::dims;
  Vec3<R> axes[d], force[n];
  for (R& s : square) s = R(scalar_of<R>(0));
  for (int j = 0; j < d; ++j) {
    const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
    for (int i = 0; i < d; ++i) axes[i] = {i == j ? one : none, none, none};
    stencil_forces<Kind>(axes, g, force);
    for (int a = 0; a < n; ++a) square[a] = multiply_add(force[a].x, force[a].x, square[a]);
  }
}

// |A^T g_a|^2 of every corner, and l_e of these vectors in place of `bound`
template <class Kind, class R>
PD_HD void metric_squares(const R (&g)[gradient_numbers<Kind>], const Mat3<R>& metric,
                          R (&square)[Kind::corners], R& bound) {
  constexpr int n = Kind::corners;
  const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
  Vec3<R> axes[3], force[n], own[n];
  for (int j = 0; j < 3; ++j) {
    for (int i = 0; i < 3; ++i) axes[i] = {i == j ? one : none, none, none};
    stencil_forces<Kind>(axes, g, force);
    for (int a = 0; a < n; ++a)
      own[a] =
          j == 0 ? force[a].x * metric.row[0] : multiply_add(force[a].x, metric.row[j], own[a]);
  }
  Mat3<R> sum = {{{none, none, none}, {none, none, none}, {none, none, none}}};
  for (int a = 0; a < n; ++a) {
    square[a] = dot(own[a], own[a]);
    const Vec3<R> unit = (one / select(none < square[a], square[a], one)) * own[a];
    sum.row[0] = multiply_add(unit.x, own[a], sum.row[0]);
    sum.row[1] = multiply_add(unit.y, own[a], sum.row[1]);
    sum.row[2] = multiply_add(unit.z, own[a], sum.row[2]);
  }
  bound = largest_eigenvalue(sum);
}

// |g_a|^2 and l_e as the majoriser takes them; `bound`: l_e of the rest shape
template <class Kind, class R>
PD_HD void majoriser_squares(const R (&g)[gradient_numbers<Kind>], const R (&p)[Kind::numbers],
                             R (&square)[Kind::corners], R& bound) {
  if constexpr (requires { Kind::metric(p); }) {
    metric_squares<Kind>(g, Kind::metric(p), square, bound);
  } else {
    gradient_squares<Kind>(g, square);
  }
}

// The second derivative of the energy along df: dP
template <class Kind, class R>
PD_HD void stress_differential(const Vec3<R> (&f)[Kind::dims], const Vec3<R> (&df)[Kind::dims],
                               const R (&p)[Kind::numbers], const R (&c)[constant_slots<Kind>],
                               Vec3<R> (&dp)[Kind::dims]) {
  if constexpr (requires { Kind::hessian(f, df, p, c, dp); }) return Kind::hessian(f, df, p, c, dp);
  using D = Dual<R>;
  const R none(scalar_of<R>(0));
  Vec3<D> at[Kind::dims], stress[Kind::dims];
  D numbers[Kind::numbers], constants[constant_slots<Kind>], energy(none, none);
  for (int j = 0; j < Kind::dims; ++j)
    at[j] = {D(f[j].x, df[j].x), D(f[j].y, df[j].y), D(f[j].z, df[j].z)};
  for (int i = 0; i < Kind::numbers; ++i) numbers[i] = D(p[i], none);
  for (int i = 0; i < constant_slots<Kind>; ++i) constants[i] = D(c[i], none);
  Kind::template stress<false>(at, numbers, constants, stress, energy);
  for (int j = 0; j < Kind::dims; ++j)
    dp[j] = {stress[j].x.slope, stress[j].y.slope, stress[j].z.slope};
}

// Derivatives by one number of the rows, `which`: of the energy, and of P : df. `memory` is null where a kind has none.
template <class Kind, class R>
struct RowDerivative {
  R energy, product;

  PD_HD RowDerivative(int which, const R (&row)[Kind::rows], const R& measure,
                      const Vec3<R> (&f)[Kind::dims], const Vec3<R> (&df)[Kind::dims],
                      const R (&c)[constant_slots<Kind>], const R* memory = nullptr) {
    using D = Dual<R>;
    const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
    D rows[Kind::rows], numbers[Kind::numbers], constants[constant_slots<Kind>], sum(none, none);
    for (int i = 0; i < Kind::rows; ++i) rows[i] = D(row[i], i == which ? one : none);
    for (int i = 0; i < constant_slots<Kind>; ++i) constants[i] = D(c[i], none);
    Kind::parameters(rows, D(measure, none), numbers);
    for (int i = 0; i < memory_of<Kind>; ++i)
      numbers[Kind::numbers - memory_of<Kind> + i] = D(memory[i], none);
    Vec3<D> at[Kind::dims], stress[Kind::dims];
    for (int j = 0; j < Kind::dims; ++j)
      at[j] = {D(f[j].x, none), D(f[j].y, none), D(f[j].z, none)};
    Kind::template stress<true>(at, numbers, constants, stress, sum);
    energy = sum.slope;
    product = none;
    for (int j = 0; j < Kind::dims; ++j) {
      const Vec3<R> slope = {stress[j].x.slope, stress[j].y.slope, stress[j].z.slope};
      product = product + dot(slope, df[j]);
    }
  }
};

// What an operation reads of the stencils that it works on: see StencilsAcross.
template <class Kind, class Stencils>
struct StencilNumbers {
  using R = typename Stencils::R;
  R g[gradient_numbers<Kind>], c[constant_slots<Kind>], p[Kind::numbers];

  PD_HD explicit StencilNumbers(const Stencils& stencils) {
    for (int i = 0; i < gradient_numbers<Kind>; ++i) g[i] = stencils.stored(i);
    for (int i = 0; i < constant_slots<Kind>; ++i)
      c[i] = i < Kind::constants ? stencils.stored(gradient_numbers<Kind> + i) : R(scalar_of<R>(0));
    for (int i = 0; i < Kind::numbers; ++i) p[i] = stencils.number(i);
  }
};

// Gradient on the corners. With `Energy` and `wanted` also the energy.
template <bool Energy>
struct StencilGradient {
  bool wanted = true;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilNumbers<Kind, Stencils> s(stencils);
    Vec3<R> x[Kind::corners], f[Kind::dims], p[Kind::dims];
    stencils.corners(0, x);
    deform<Kind>(x, s.g, f);
    R energy(scalar_of<R>(0));
    Kind::template stress<Energy>(f, s.p, s.c, p, energy);
    if (Energy && wanted) stencils.sum() = stencils.sum() + energy;
    stencil_forces<Kind>(p, s.g, x);
    stencils.add(x);
  }
};

// Work on the stencils alone that dissipate.
template <class Element>
struct Dissipating {
  Element element;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    if constexpr (dissipates<Kind>) element.template run<Kind>(stencils);
  }
};

// Replaces the memory by the slope by it of gradient times field 1.
struct StencilMemorySlope {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    if constexpr (memory_of<Kind> > 0) {
      using R = typename Stencils::R;
      const StencilNumbers<Kind, Stencils> s(stencils);
      Vec3<R> x[Kind::corners], f[Kind::dims], df[Kind::dims];
      R slope[memory_of<Kind>];
      stencils.corners(0, x);
      deform<Kind>(x, s.g, f);
      stencils.corners(1, x);
      deform<Kind>(x, s.g, df);
      Kind::memory_slope(f, df, s.p, s.c, slope);
      stencils.remember(slope);
    }
  }
};

// That slope by the positions at the start of the step, which are field 0.
struct StencilStartSlope {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    if constexpr (memory_of<Kind> > 0) {
      using R = typename Stencils::R;
      const StencilNumbers<Kind, Stencils> s(stencils);
      Vec3<R> x[Kind::corners], f[Kind::dims], p[Kind::dims];
      R slope[memory_of<Kind>];
      for (int i = 0; i < memory_of<Kind>; ++i) slope[i] = s.p[Kind::numbers - memory_of<Kind> + i];
      stencils.corners(0, x);
      deform<Kind>(x, s.g, f);
      Kind::begin_slope(f, slope, p);
      stencil_forces<Kind>(p, s.g, x);
      stencils.add(x);
    }
  }
};

// Forces of the stress that stands in place of the first numbers of a stencil which keeps a history.
struct StencilStored {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    if constexpr (history_of<Kind> > 0) {
      using R = typename Stencils::R;
      static_assert(3 * Kind::dims <= Kind::numbers);
      const StencilNumbers<Kind, Stencils> s(stencils);
      Vec3<R> x[Kind::corners], p[Kind::dims];
      for (int j = 0; j < Kind::dims; ++j) p[j] = {s.p[3 * j], s.p[3 * j + 1], s.p[3 * j + 2]};
      stencil_forces<Kind>(p, s.g, x);
      stencils.add(x);
    }
  }
};

// Makes the memory, from the positions at the start of the step, which are field 0.
struct StencilBegin {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    if constexpr (memory_of<Kind> > 0) {
      using R = typename Stencils::R;
      const StencilNumbers<Kind, Stencils> s(stencils);
      Vec3<R> x[Kind::corners], f[Kind::dims];
      R memory[memory_of<Kind>];
      stencils.corners(0, x);
      deform<Kind>(x, s.g, f);
      Kind::begin(f, memory);
      stencils.remember(memory);
    }
  }
};

// No work on stencils.
struct NoStencils {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils&) const {}
};

// Second derivative of every energy at field 0, along field 1.
struct StencilHessian {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilNumbers<Kind, Stencils> s(stencils);
    Vec3<R> x[Kind::corners], f[Kind::dims], df[Kind::dims], dp[Kind::dims];
    stencils.corners(0, x);
    deform<Kind>(x, s.g, f);
    stencils.corners(1, x);
    deform<Kind>(x, s.g, df);
    stress_differential<Kind>(f, df, s.p, s.c, dp);
    stencil_forces<Kind>(dp, s.g, x);
    stencils.add(x);
  }
};

// Diagonal of the majoriser, or of the stiffness at rest without `bounded`. It is minus infinity where the material is
// negative, so that no neighbour can compensate.
struct StencilDiagonal {
  bool bounded = true;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilNumbers<Kind, Stencils> s(stencils);
    const R none(scalar_of<R>(0)), one(scalar_of<R>(1)), corners{scalar_of<R>(Kind::corners)};
    R square[Kind::corners], bound = stencils.bound();
    if (bounded) {
      majoriser_squares<Kind>(s.g, s.p, square, bound);
    } else {
      gradient_squares<Kind>(s.g, square);
    }
    const R weight = bounded ? Kind::weight(s.p, bound, corners) : rest_weight<Kind>(s.p);
    Vec3<R> d[Kind::corners];
    for (int a = 0; a < Kind::corners; ++a) {
      const R entry = select(weight < none, R(-HUGE_VAL), weight * square[a]);
      d[a] = {entry, entry, entry};
    }
    stencils.add(d);
  }
};

// Whether a stencil counts as inverted: 1 or 0
template <class Kind, class R>
PD_HD R is_inverted(const Vec3<R> (&f)[Kind::dims], const R (&p)[Kind::numbers]) {
  const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
  if constexpr (inverts<Kind>) {
    const auto counts = dot(f[0], cross(f[1], f[2])) <= none && Kind::weight(p, one, one) > none;
    return select(counts, one, none);
  }
  return none;
}

// Terms of a report for each corner: its share of the energy; the force per relative error of positions; its share of
// an inverted tetrahedron.
struct StencilReport {
  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    using T = scalar_of<R>;
    const StencilNumbers<Kind, Stencils> s(stencils);
    const R none(T(0)), one(T(1));
    Vec3<R> x[Kind::corners], f[Kind::dims], p[Kind::dims];
    stencils.corners(0, x);
    deform<Kind>(x, s.g, f);
    R energy = none, size = none, square[Kind::corners], bound = one;
    Kind::template stress<true>(f, s.p, s.c, p, energy);
    for (int a = 0; a < Kind::corners; ++a) size = -lesser(-size, -dot(x[a], x[a]));
    size = square_root(size);
    majoriser_squares<Kind>(s.g, s.p, square, bound);
    const R part(T(1) / T(Kind::corners)), weight = Kind::weight(s.p, one, one);
    const R share = part * energy, inverted = part * is_inverted<Kind>(f, s.p);
    for (int a = 0; a < Kind::corners; ++a) x[a] = {share, (weight * square[a]) * size, inverted};
    stencils.add(x);
  }
};

}  // namespace pd::inline PD_TARGET
