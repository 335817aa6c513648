// Elastic solid with Poisson's ratio: corotated elasticity with capped tension, its trace averaged over a group of
// tetrahedra against locking. Without lambda it is the energy of elements/solid.h.
//
//   E   = sum_e V_e mu_e |F_e - R_e|^2 + (sum_e V_e lambda_e) phi(t),   phi(t) = t^2 / 2 up to c, c t - c^2 / 2 beyond
//   t   = sum_e V_e lambda_e t_e / sum_e V_e lambda_e,   t_e = R_e : (F_e - R_e),   c = min_e 2 mu_e / lambda_e
//   P_e = 2 mu_e (F_e - R_e) + p_e R_e = (2 mu_e - p_e)(F_e - R_e) + p_e F_e,   p_e = lambda_e phi'(t) <= 2 mu_e
//
// The cap keeps the factor of R_e negative. Then E has a constant majoriser: R_e maximises tr(R^T F_e), which is convex
// in F_e. Beyond the cap an element's second derivative has no bound. A group's t_e average with constant weights, so
// the majoriser of single elements holds for groups.
//
// t_e comes from F - R. The largest root of the quartic minus three would lose five times as many digits, which lambda
// multiplies.
#pragma once
#include "math/rotation.h"

#include <type_traits>

namespace pd::inline PD_TARGET {

// Elements in groups: `members` packs after one another, with a `pressure` beside the weight: V lambda and V 2 mu.
template <class Elements>
concept Grouped = requires { requires(Elements::members > 0); };

// A group whose members are all at hand. Elsewhere other lanes have some of them: then sum(a) and least(a) combine a
// number with theirs, and any(mask) is true in all of them or none.
struct WholeGroup {
  template <class R>
  PD_HD R sum(const R& a) const {
    return a;
  }
  template <class R>
  PD_HD R least(const R& a) const {
    return a;
  }
  template <class Mask>
  PD_HD bool any(const Mask& mask) const {
    return pd::any(mask);
  }
};

// R : (F - R) from F and F - R
template <class R>
PD_HD R trace_strain(const Mat3<R>& f, const Mat3<R>& strain) {
  return frobenius(f - strain, strain);
}

// Average over a group, with the weights V lambda; zero where none has any.
template <class R, int Members, class Lanes = WholeGroup>
PD_HD R group_average(const R (&value)[Members], const R (&pressure)[Members],
                      const Lanes& lanes = {}) {
  if constexpr (Members == 1 && std::is_same_v<Lanes, WholeGroup>) {
    return value[0];
  } else {
    R sum = pressure[0], product = pressure[0] * value[0];
    for (int m = 1; m < Members; ++m) {
      sum = sum + pressure[m];
      product = multiply_add(pressure[m], value[m], product);
    }
    sum = lanes.sum(sum);
    product = lanes.sum(product);
    using T = scalar_of<R>;
    return product * reciprocal(select(lesser(sum, -sum) < R(T(0)), sum, R(T(1))));
  }
}

// phi of a group and its derivatives at the group's t
template <class R>
struct GroupTension {
  R trace, slope;  // t and phi'
  R limit;         // c, infinite where nothing is capped

  // `weight`: V 2 mu of the members; `pressure`: V lambda
  template <int Members, class Lanes = WholeGroup>
  PD_HD GroupTension(const R (&traces)[Members], const R (&weight)[Members],
                     const R (&pressure)[Members], const Lanes& lanes = {})
      : trace(group_average(traces, pressure, lanes)), slope(trace), limit(scalar_of<R>(HUGE_VAL)) {
    auto below = trace * pressure[0] <= weight[0];
    for (int m = 1; m < Members; ++m) below = below && trace * pressure[m] <= weight[m];
    if (lanes.any(!below)) [[unlikely]]
      cap(weight, pressure, lanes);
  }

  PD_HD R energy() const {
    const R half(scalar_of<R>(0.5));
    return slope * (trace - half * slope);
  }
  // phi'': one, or zero beyond the cap
  PD_HD R curvature() const {
    using T = scalar_of<R>;
    return select(limit < trace, R(T(0)), R(T(1)));
  }

 private:
  template <int Members, class Lanes>
  PD_HD void cap(const R (&weight)[Members], const R (&pressure)[Members], const Lanes& lanes) {
    using T = scalar_of<R>;
    for (int m = 0; m < Members; ++m) {
      const R own = select(pressure[m] > R(T(0)), weight[m] / pressure[m], R(T(HUGE_VAL)));
      limit = lesser(limit, own);
    }
    limit = lanes.least(limit);
    slope = lesser(trace, limit);
  }
};

// V P = (V 2 mu - V p)(F - R) + V p F
template <class R>
PD_HD Mat3<R> corotated_stress(const Mat3<R>& f, const Mat3<R>& strain, const R& weight,
                               const R& tension) {
  const R rest = weight - tension;
  Mat3<R> stress;
  for (int a = 0; a < 3; ++a) stress.row[a] = multiply_add(tension, f.row[a], rest * strain.row[a]);
  return stress;
}

// V dP = V 2 mu dF - (V 2 mu - V p) dR + [V lambda phi'' dt] R
template <class R>
PD_HD Mat3<R> corotated_stress_change(const Mat3<R>& df, const Mat3<R>& rotation, const Mat3<R>& dr,
                                      const R& weight, const R& tension, const R& change) {
  const R rest = weight - tension;
  Mat3<R> stress;
  for (int a = 0; a < 3; ++a) {
    stress.row[a] = multiply_add(change, rotation.row[a],
                                 subtract_product(weight * df.row[a], rest, dr.row[a]));
  }
  return stress;
}

// Derivatives by V 2 mu and by V lambda of each member of a group: of its energy, or of dE along a direction.
template <class R, int Members, class Lanes = WholeGroup>
struct ParameterSlopes {
  R by_weight[Members], by_pressure[Members];

  // E: `squares` are |F - R|^2 / 2.
  PD_HD static ParameterSlopes of_energy(const GroupTension<R>& tension, const R (&traces)[Members],
                                         const R (&squares)[Members], const R (&weight)[Members],
                                         const R (&pressure)[Members], const Lanes& lanes = {}) {
    ParameterSlopes slopes;
    slopes.share_cap(tension, tension.trace - tension.limit, weight, pressure, lanes);
    for (int m = 0; m < Members; ++m) {
      slopes.by_weight[m] = slopes.by_weight[m] + squares[m];
      slopes.by_pressure[m] =
          slopes.by_pressure[m] +
          multiply_add(tension.slope, traces[m] - tension.trace, tension.energy());
    }
    return slopes;
  }

  // dE = sum_e V 2 mu (F - R) : dF + (sum_e V lambda) phi'(t) dt: `strains` are (F - R) : dF, `changes` R : dF.
  PD_HD static ParameterSlopes of_product(const GroupTension<R>& tension,
                                          const R (&traces)[Members], const R (&strains)[Members],
                                          const R (&changes)[Members], const R (&weight)[Members],
                                          const R (&pressure)[Members], const Lanes& lanes = {}) {
    ParameterSlopes slopes;
    const R change = group_average(changes, pressure, lanes);
    const R curved = tension.curvature() * change;
    slopes.share_cap(tension, change, weight, pressure, lanes);
    for (int m = 0; m < Members; ++m) {
      slopes.by_weight[m] = slopes.by_weight[m] + strains[m];
      slopes.by_pressure[m] =
          slopes.by_pressure[m] +
          multiply_add(curved, traces[m] - tension.trace, tension.slope * changes[m]);
    }
    return slopes;
  }

 private:
  // By the cap, whose factor is (sum_e V lambda) `slope`: members that attain it have equal parts of its derivative.
  PD_HD void share_cap(const GroupTension<R>& tension, const R& slope, const R (&weight)[Members],
                       const R (&pressure)[Members], const Lanes& lanes) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1));
    R sum = none, attained = none, attains[Members];
    for (int m = 0; m < Members; ++m) {
      const R own = select(pressure[m] > none, weight[m] / pressure[m], R(T(HUGE_VAL)));
      attains[m] = select(own <= tension.limit && tension.limit < tension.trace, one, none);
      attained = attained + attains[m];
      sum = sum + pressure[m];
    }
    sum = lanes.sum(sum);
    attained = lanes.sum(attained);
    const R share = sum * slope / select(attained > none, attained, one);
    for (int m = 0; m < Members; ++m) {
      by_weight[m] = select(attains[m] > none, share / pressure[m], none);
      by_pressure[m] = select(attains[m] > none, -(by_weight[m] * (weight[m] / pressure[m])), none);
    }
  }
};

}  // namespace pd::inline PD_TARGET
