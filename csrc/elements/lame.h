// Lame's constants of an isotropic material from Young's modulus E and Poisson's ratio nu.
//
//   2 mu = E / (1 + nu),   lambda = E nu / ((1 + nu)(1 - 2 nu))
#pragma once
#include "math/scalar.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// What the weights of tetrahedra are for: forces, the diagonal that cannot diverge, or the plain one.
enum class WeightKind { force, majoriser, matrix };

template <class T>
struct Lame {
  T twice_mu, lambda;  // [Pa]

  PD_HD Lame(T youngs, T poisson)
      : twice_mu(youngs / (T(1) + poisson)),
        lambda(twice_mu * (poisson / (T(1) - T(2) * poisson))) {}

  // Stiffness in the diagonal of the majoriser, for the bound l_e of an element: l_e 2 mu + 4 lambda. A negative lambda
  // lowers no entry.
  PD_HD T majoriser(T bound) const {
    return bound * twice_mu + T(4) * (lambda > T(0) ? lambda : T(0));
  }

  // Stiffness of the scalar matrix A that preconditioners are made of.
  PD_HD T matrix() const { return twice_mu + lambda; }

  PD_HD T of(WeightKind kind, T bound) const {
    return kind == WeightKind::majoriser ? majoriser(bound)
           : kind == WeightKind::matrix  ? matrix()
                                         : twice_mu;
  }
};

// What the scalar matrix A weighs the tetrahedra of an environment with [Pa]: Young's modulus without Poisson's ratio.
template <class T>
struct MatrixStiffness {
  const T *youngs, *poisson;  // the second may be null

  PD_HD MatrixStiffness(const Values<T>& stiffness, const Effects<T>& effects,
                        std::int64_t environment)
      : youngs(stiffness.of(environment)),
        poisson(effects.poisson.data ? effects.poisson.of(environment) : nullptr) {}

  PD_HD T operator()(std::int64_t tet) const {
    return poisson ? Lame<T>(youngs[tet], poisson[tet]).matrix() : youngs[tet];
  }
};

// Their derivatives by E and by nu.
template <class T>
struct LameSlopes {
  T mu_by_youngs, lambda_by_youngs;    // of 2 mu and lambda by E
  T mu_by_poisson, lambda_by_poisson;  // by nu [Pa]

  PD_HD LameSlopes(T youngs, T poisson) {
    const T one = T(1) + poisson, two = T(1) - T(2) * poisson, share = T(1) / one;
    mu_by_youngs = share;
    lambda_by_youngs = share * (poisson / two);
    mu_by_poisson = -(youngs * share) * share;
    lambda_by_poisson =
        (youngs * share) * share * ((T(1) + T(2) * poisson * poisson) / (two * two));
  }

  // Slopes by V 2 mu and V lambda to those by E and nu, in place.
  PD_HD void chain(T volume, T* slope) const {
    const T weight = volume * slope[0], pressure = volume * slope[1];
    slope[0] = weight * mu_by_youngs + pressure * lambda_by_youngs;
    slope[1] = weight * mu_by_poisson + pressure * lambda_by_poisson;
  }
};

}  // namespace pd::inline PD_TARGET
