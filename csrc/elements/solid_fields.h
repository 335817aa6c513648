// Numbers of single tetrahedra: energies, and derivatives by the material. Each passes them to write(elements, s,
// numbers...).
#pragma once
#include "elements/solid.h"

namespace pd::inline PD_TARGET {

// Energy of every element; with Poisson's ratio its share V (mu |F - R|^2 + lambda phi(t)) of its group's.
struct ElementEnergy {
  template <int N, class Elements, class Write>
  PD_HD void run(const Elements& elements, const Write& write) const {
    using R = typename Elements::R;
    [[maybe_unused]] R tension[N];
    if constexpr (Grouped<Elements>)
      each_tension<N>(elements, [&](int s, const R& energy) { tension[s] = energy; });
    for (int s = 0; s < N; ++s) {
      Vec3<R> x[4];
      elements.corners(s, 0, x);
      const Mat3<R> d = strain(x, elements.rest(s));
      R energy = R(scalar_of<R>(0.5)) * elements.weight(s) * frobenius(d, d);
      if constexpr (Grouped<Elements>) energy = energy + tension[s];
      write(elements, s, energy);
    }
  }
};

// Derivative of that energy along field 1.
struct ElementEnergyProduct {
  template <int N, class Elements, class Write>
  PD_HD void run(const Elements& elements, const Write& write) const {
    using R = typename Elements::R;
    if constexpr (Grouped<Elements>) {
      constexpr int members = Elements::members;
      for (int first = 0; first < N; first += members) {
        const GroupChange<R, members> group(elements, first);
        const GroupTension<R> tension(group.trace, group.weight, group.pressure, elements.lanes());
        const R change =
            tension.slope * group_average(group.change, group.pressure, elements.lanes());
        for (int m = 0; m < members; ++m)
          write(elements, first + m,
                multiply_add(group.pressure[m], change, group.weight[m] * group.strain_change(m)));
      }
    } else {
      for (int s = 0; s < N; ++s) {
        Vec3<R> x[4], dx[4];
        elements.corners(s, 0, x);
        elements.corners(s, 1, dx);
        write(elements, s, element_energy_product(x, dx, elements.rest(s), elements.weight(s)));
      }
    }
  }
};

// Derivatives of the energy by V 2 mu and V lambda of every element in a group.
struct LameSlope {
  template <int N, class Elements, class Write>
  PD_HD void run(const Elements& elements, const Write& write) const {
    using R = typename Elements::R;
    if constexpr (Grouped<Elements>) {
      constexpr int members = Elements::members;
      for (int first = 0; first < N; first += members) {
        const GroupState<R, members> group(elements, first);
        const GroupTension<R> tension(group.trace, group.weight, group.pressure, elements.lanes());
        R squares[members];
        for (int m = 0; m < members; ++m) squares[m] = group.square(m);
        const auto lanes = elements.lanes();
        const auto slopes = ParameterSlopes<R, members, decltype(lanes)>::of_energy(
            tension, group.trace, squares, group.weight, group.pressure, lanes);
        for (int m = 0; m < members; ++m)
          write(elements, first + m, slopes.by_weight[m], slopes.by_pressure[m]);
      }
    }
  }
};

// The same of the energy's derivative along field 1.
struct LameProduct {
  template <int N, class Elements, class Write>
  PD_HD void run(const Elements& elements, const Write& write) const {
    using R = typename Elements::R;
    if constexpr (Grouped<Elements>) {
      constexpr int members = Elements::members;
      for (int first = 0; first < N; first += members) {
        const GroupChange<R, members> group(elements, first);
        const GroupTension<R> tension(group.trace, group.weight, group.pressure, elements.lanes());
        R strains[members];
        for (int m = 0; m < members; ++m) strains[m] = group.strain_change(m);
        const auto lanes = elements.lanes();
        const auto slopes = ParameterSlopes<R, members, decltype(lanes)>::of_product(
            tension, group.trace, strains, group.change, group.weight, group.pressure, lanes);
        for (int m = 0; m < members; ++m)
          write(elements, first + m, slopes.by_weight[m], slopes.by_pressure[m]);
      }
    }
  }
};

}  // namespace pd::inline PD_TARGET
