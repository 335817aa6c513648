// Elastic solid: the energy of one tetrahedron is its distance from a rotation.
//
//   E = w V / 2 |F - R|^2,   F = Ds Dm^-1,   R = nearest rotation to F       (Vyatkin and Dolgovesov 2023; st = w / 2)
//   dE/dx_c = w V (F - R) grad N_c,   grad N_c = row c-1 of Dm^-1 for c > 0, minus their sum for c = 0
//
// R is constant in the gradient: it maximises tr(R^T F), so its own change does no first-order work. Elements with
// Poisson's ratio come in groups, see elements/corotated.h; for them w is 2 mu.
#pragma once
#include "elements/corotated.h"
#include "elements/solid_pair.h"

namespace pd::inline PD_TARGET {

template <class R>
PD_HD Mat3<R> deformation_gradient(const Vec3<R> (&x)[4], const Mat3<R>& rest_inverse) {
  return from_columns(x[1] - x[0], x[2] - x[0], x[3] - x[0]) * rest_inverse;
}

template <class R>
PD_HD Mat3<R> deformation_gradient(const Vec3<R> (&x)[4], const FaceRest<R, 1>& rest) {
  const Vec3<R> a = x[1] - x[0], b = x[2] - x[0], &apex = rest.apex[0];
  return from_columns(rest.p * a, multiply_add(rest.r, b, rest.q * a),
                      multiply_add(apex.z, x[3] - x[0], multiply_add(apex.y, b, apex.x * a)));
}

// grad N_c of the four corners [1/m]
template <class R>
PD_HD void shape_gradients(const Mat3<R>& rest_inverse, Vec3<R> (&n)[4]) {
  for (int c = 0; c < 3; ++c) n[c + 1] = rest_inverse.row[c];
  n[0] = (-n[1] - n[2]) - n[3];
}

// P grad N_c of the four corners, for a stress P
template <class R>
PD_HD void corner_forces(const Mat3<R>& stress, const Mat3<R>& rest_inverse, Vec3<R> (&g)[4]) {
  for (int c = 0; c < 3; ++c) g[c + 1] = stress * rest_inverse.row[c];
  g[0] = (-g[1] - g[2]) - g[3];
}

template <class R>
PD_HD void shape_gradients(const FaceRest<R, 1>& rest, Vec3<R> (&n)[4]) {
  shape_gradients(rest.inverse(0), n);
}

template <class R>
PD_HD void corner_forces(const Mat3<R>& stress, const FaceRest<R, 1>& rest, Vec3<R> (&g)[4]) {
  const Mat3<R> column = transpose(stress);
  const Vec3<R>& apex = rest.apex[0];
  g[1] = multiply_add(apex.x, column.row[2],
                      multiply_add(rest.q, column.row[1], rest.p * column.row[0]));
  g[2] = multiply_add(apex.y, column.row[2], rest.r * column.row[1]);
  g[3] = apex.z * column.row[2];
  g[0] = (-g[1] - g[2]) - g[3];
}

// F - R: how far the element is from its rest shape
template <class R, class Rest>
PD_HD Mat3<R> strain(const Vec3<R> (&x)[4], const Rest& rest_inverse) {
  const Mat3<R> f = deformation_gradient(x, rest_inverse);
  return f - nearest_rotation(f);
}

// Gradient on the four corners of every element. With `Energy` and `wanted` also the energy. Each stage runs over N
// packs of elements, so that their chains of dependent operations overlap.
template <bool Energy>
struct SolidGradient {
  static constexpr int strip = 4;
  static constexpr bool on_faces = true;
  bool wanted = true;

  template <class R, int Count>
  PD_HD void run_face(const Vec3<R> (&x)[3 + Count], const FaceRest<R, Count>& rest,
                      const R (&weight)[Count], Vec3<R> (&g)[3 + Count], R& energy) const {
    solid_face_gradient<Energy>(x, rest, weight, wanted, g, energy);
  }
  // The same of one group with Poisson's ratio, or of the part of it that a lane has.
  template <class R, int Count, class Lanes>
  PD_HD void run_group(const Vec3<R> (&x)[3 + Count], const FaceRest<R, Count>& rest,
                       const R (&weight)[Count], const R (&pressure)[Count], bool alone,
                       const Lanes& lanes, Vec3<R> (&g)[3 + Count], R& energy) const {
    corotated_face_gradient<Energy>(x, rest, weight, pressure, alone, lanes, wanted, g, energy);
  }

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    Mat3<R> f[N];
    Invariants<R> i[N];
    Root<R> root[N];
    for (int s = 0; s < N; ++s) {
      Vec3<R> x[4];
      elements.corners(s, 0, x);
      f[s] = deformation_gradient(x, elements.rest(s));
      i[s] = invariants(f[s]);
    }
    for (int s = 0; s < N; ++s) root[s] = largest_root(i[s]);
    if constexpr (Grouped<Elements>) {
      run_groups<N>(elements, f, i, root);
    } else {
      run_each<N>(elements, f, i, root);
    }
  }

 private:
  template <int N, class Elements, class R>
  PD_HD void run_each(const Elements& elements, const Mat3<R> (&f)[N], const Invariants<R> (&i)[N],
                      const Root<R> (&root)[N]) const {
    for (int s = 0; s < N; ++s) {
      const R weight = elements.weight(s);
      Mat3<R> stress = finish_strain(f[s], i[s], root[s], Energy ? R(scalar_of<R>(1)) : weight);
      if (Energy) {
        if (wanted) {
          elements.sum(s) = multiply_add(R(scalar_of<R>(0.5)) * weight, frobenius(stress, stress),
                                         elements.sum(s));
        }
        stress = weight * stress;
      }
      Vec3<R> g[4];
      corner_forces(stress, elements.rest(s), g);
      elements.add(s, g);
    }
  }

  template <int N, class Elements, class R>
  PD_HD void run_groups(const Elements& elements, const Mat3<R> (&f)[N],
                        const Invariants<R> (&i)[N], const Root<R> (&root)[N]) const {
    constexpr int members = Elements::members;
    const R half(scalar_of<R>(0.5));
    for (int first = 0; first < N; first += members) {
      Mat3<R> strain[members];
      R trace[members], weight[members], pressure[members];
      for (int m = 0; m < members; ++m) {
        const int s = first + m;
        strain[m] = finish_strain(f[s], i[s], root[s], R(scalar_of<R>(1)));
        trace[m] = trace_strain(f[s], strain[m]);
        weight[m] = elements.weight(s);
        pressure[m] = elements.pressure(s);
      }
      const GroupTension<R> tension(trace, weight, pressure, elements.lanes());
      for (int m = 0; m < members; ++m) {
        const int s = first + m;
        if (Energy && wanted) {
          elements.sum(s) =
              multiply_add(half * weight[m], frobenius(strain[m], strain[m]),
                           multiply_add(pressure[m], tension.energy(), elements.sum(s)));
        }
        Vec3<R> g[4];
        corner_forces(corotated_stress(f[s], strain[m], weight[m], pressure[m] * tension.slope),
                      elements.rest(s), g);
        elements.add(s, g);
      }
    }
  }
};

// Second derivative of the energy along `dx`, on the four corners: w V (dF - dR) grad N_c.
template <class R, class Rest>
PD_HD void solid_hessian_product(const Vec3<R> (&x)[4], const Vec3<R> (&dx)[4],
                                 const Rest& rest_inverse, const R& weight, Vec3<R> (&g)[4]) {
  const Mat3<R> f = deformation_gradient(x, rest_inverse),
                df = deformation_gradient(dx, rest_inverse);
  const Mat3<R> dr = rotation_differential(f, nearest_rotation(f), df);
  corner_forces(weight * (df - dr), rest_inverse, g);
}

// The same for many directions at one position, which `jacobian` holds.
template <class R, class Rest>
PD_HD void solid_hessian_product(const RotationJacobian<R>& jacobian, const Vec3<R> (&dx)[4],
                                 const Rest& rest_inverse, const R& weight, Vec3<R> (&g)[4]) {
  const Mat3<R> df = deformation_gradient(dx, rest_inverse);
  corner_forces(weight * (df - jacobian.differential(df)), rest_inverse, g);
}

// Derivative of the energy along `dx`: w V (F - R) : dF
template <class R, class Rest>
PD_HD R element_energy_product(const Vec3<R> (&x)[4], const Vec3<R> (&dx)[4],
                               const Rest& rest_inverse, const R& weight) {
  return weight * frobenius(strain(x, rest_inverse), deformation_gradient(dx, rest_inverse));
}

// A group of elements at field 0.
template <class R, int Members>
struct GroupState {
  Mat3<R> f[Members], rotation[Members];
  R trace[Members], weight[Members], pressure[Members];

  template <class Elements>
  PD_HD GroupState(const Elements& elements, int first) {
    for (int m = 0; m < Members; ++m) {
      Vec3<R> x[4];
      elements.corners(first + m, 0, x);
      f[m] = deformation_gradient(x, elements.rest(first + m));
      rotation[m] = nearest_rotation(f[m]);
      trace[m] = frobenius(rotation[m], f[m] - rotation[m]);
      weight[m] = elements.weight(first + m);
      pressure[m] = elements.pressure(first + m);
    }
  }

  // |F - R|^2 / 2
  PD_HD R square(int m) const {
    const Mat3<R> strain = f[m] - rotation[m];
    return R(scalar_of<R>(0.5)) * frobenius(strain, strain);
  }
};

// The same with its derivative along field 1.
template <class R, int Members>
struct GroupChange : GroupState<R, Members> {
  Mat3<R> df[Members];
  R change[Members];  // R : dF

  template <class Elements>
  PD_HD GroupChange(const Elements& elements, int first) : GroupState<R, Members>(elements, first) {
    for (int m = 0; m < Members; ++m) {
      Vec3<R> dx[4];
      elements.corners(first + m, 1, dx);
      df[m] = deformation_gradient(dx, elements.rest(first + m));
      change[m] = frobenius(this->rotation[m], df[m]);
    }
  }

  // (F - R) : dF
  PD_HD R strain_change(int m) const { return frobenius(this->f[m] - this->rotation[m], df[m]); }
};

// Second derivative of every element's energy at field 0, along field 1.
struct SolidHessian {
  static constexpr int strip = 1;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    if constexpr (Grouped<Elements>) {
      run_groups<N, R>(elements);
    } else {
      for (int s = 0; s < N; ++s) {
        Vec3<R> x[4], dx[4], g[4];
        elements.corners(s, 0, x);
        elements.corners(s, 1, dx);
        solid_hessian_product(x, dx, elements.rest(s), elements.weight(s), g);
        elements.add(s, g);
      }
    }
  }

 private:
  template <int N, class R, class Elements>
  PD_HD void run_groups(const Elements& elements) const {
    constexpr int members = Elements::members;
    for (int first = 0; first < N; first += members) {
      const GroupChange<R, members> group(elements, first);
      const GroupTension<R> tension(group.trace, group.weight, group.pressure, elements.lanes());
      const R change =
          tension.curvature() * group_average(group.change, group.pressure, elements.lanes());
      for (int m = 0; m < members; ++m) {
        const Mat3<R> dr = rotation_differential(group.f[m], group.rotation[m], group.df[m]);
        Vec3<R> g[4];
        corner_forces(
            corotated_stress_change(group.df[m], group.rotation[m], dr, group.weight[m],
                                    group.pressure[m] * tension.slope, group.pressure[m] * change),
            elements.rest(first + m), g);
        elements.add(first + m, g);
      }
    }
  }
};

// Diagonal of the majoriser on the four corners: l_e w V |grad N_c|^2 in every component, from the weight l_e w V. It
// is minus infinity where that is negative, so that no neighbour can compensate.
struct SolidDiagonal {
  static constexpr int strip = 1;
  static constexpr bool weights_alone = true;  // reads neither positions nor groups

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    for (int s = 0; s < N; ++s) {
      Vec3<R> n[4], d[4];
      shape_gradients(elements.rest(s), n);
      for (int c = 0; c < 4; ++c) {
        const R weight = elements.weight(s);
        const R entry = select(weight < R(0), R(-HUGE_VAL), weight * dot(n[c], n[c]));
        d[c] = {entry, entry, entry};
      }
      elements.add(s, d);
    }
  }
};

// V lambda phi(t) of every element, t of its group; `visit(s, energy)`.
template <int N, class Elements, class Visit>
PD_HD void each_tension(const Elements& elements, const Visit& visit) {
  using R = typename Elements::R;
  constexpr int members = Elements::members;
  for (int first = 0; first < N; first += members) {
    const GroupState<R, members> group(elements, first);
    const R energy =
        GroupTension<R>(group.trace, group.weight, group.pressure, elements.lanes()).energy();
    for (int m = 0; m < members; ++m) visit(first + m, group.pressure[m] * energy);
  }
}

// Terms of a report, for each corner of an element. They are a quarter of the energy [J]; w V |grad N_c|^2 |x|, the
// force per relative error of positions [N]; and a quarter if det F <= 0. Padding has no weight and adds zeros. With
// Poisson's ratio w is 2 mu + 3 lambda, the stiffness against dilation, in that force.
struct SolidReport {
  static constexpr int strip = 1;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    using R = typename Elements::R;
    using T = scalar_of<R>;
    const R none(T(0)), quarter(T(0.25));
    [[maybe_unused]] R tension[N];
    if constexpr (Grouped<Elements>)
      each_tension<N>(elements, [&](int s, const R& energy) { tension[s] = energy; });
    for (int s = 0; s < N; ++s) {
      Vec3<R> x[4], n[4], share[4];
      elements.corners(s, 0, x);
      shape_gradients(elements.rest(s), n);
      R weight = elements.weight(s);
      const Mat3<R> f = deformation_gradient(x, elements.rest(s)), d = f - nearest_rotation(f);
      R energy = (R(T(0.125)) * weight) * frobenius(d, d);
      const auto inverted = determinant(f) <= none && weight > none;
      if constexpr (Grouped<Elements>) {
        energy = multiply_add(quarter, tension[s], energy);
        const R pressure = elements.pressure(s);
        weight = multiply_add(R(T(3)), select(pressure > none, pressure, none), weight);
      }
      R size = none;
      for (int c = 0; c < 4; ++c) size = -lesser(-size, -dot(x[c], x[c]));
      size = square_root(size);
      for (int c = 0; c < 4; ++c)
        share[c] = {energy, (weight * dot(n[c], n[c])) * size, select(inverted, quarter, none)};
      elements.add(s, share);
    }
  }
};

}  // namespace pd::inline PD_TARGET
