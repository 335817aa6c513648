// The adjoint of vertices that slide against friction.
//
// At a vertex with one contact of normal n, friction mu and slip s, let r be the gradient of the step's objective, P
// = 1 - n n^T and d = s / |s|. A solved step satisfies
//
//   P r + mu (n . r) d = 0        and n . x' = const.
//
// The derivative by x' is G H P + kappa Q with G = P + mu d n^T. Q = 1 - n n^T - d d^T is the direction in which the
// slip rotates, and kappa = mu (n . r) / |s|. So for a loss L the multiplier is l = G^T y, where
//
//   A y = P dL/dx',   A = P H G^T + kappa Q,
//
// and dL/dp = -l . dr/dp for all that r depends on; the start of the slip adds kappa Q y. On a sphere the normal
// rotates too. With R the distance from the centre to the vertex and m the motion along the normal, three terms
// change: P H P loses (n . r) / R, as without friction; it loses mu^2 (n . r) / R along d; and kappa Q is multiplied
// by 1 - m / R.
//
// At a vertex between two planes P leaves the edge alone, and d lies along it and does not rotate. The sum of mu_k
// m_k replaces mu n, with m_k dual to the normals: r is the sum of (m_k . r) n_k. The steps themselves apply the
// friction of one plane before the other has pushed back. That differs by (push / (D |s|))^2 if that other one is
// smooth, and without the square if both are rough. A vertex held by more contacts, or by a sphere and another,
// counts as frictionless.
//
// A is not symmetric. Conjugate gradients first solve its symmetric part P H P + kappa Q (solver/adjoint/conjugate_gradients.h) and
// find whether H is positive. BiCGStab (van der Vorst 1992) continues from there with the same preconditioner. It
// solves for a correction of y, which is added if it makes the true residual smaller, and repeats while that halves.
#pragma once
#include "math/mat.h"
#include "solver/adjoint/conjugate_gradients.h"
#include "solver/adjoint/system.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// The next product of an environment: A y for the true residual, or one of the two of a BiCGStab iteration.
enum class FrictionStage : int { done, residual, first, second };

// BiCGStab may take so many products for each product of the symmetric solve.
constexpr int friction_products = 10;
// The true residual suffices at this multiple of the tolerance: rounding keeps it above the recurrences' residual.
constexpr double friction_enough = 10;

// One environment's numbers between products, as in FrictionProgress. `scale`: |right side|.
struct FrictionSolve {
  double scale, product = 0, error = 0;
  int products_left = 0;  // products products_left; those of the symmetric part before
  FrictionStage stage = FrictionStage::done;
  double step = 0, weight = 0;

  // `from`: null where no vertex slides in any environment
  PD_HD FrictionSolve(const double* from, double scale) : scale(scale) {
    if (!from) return;
    product = from[friction_product];
    error = from[friction_error];
    products_left = int(from[friction_products_left]);
    stage = FrictionStage(int(from[friction_stage]));
  }

  PD_HD void write(double* to) const {
    to[friction_product] = product;
    to[friction_error] = error;
    to[friction_products_left] = products_left;
    to[friction_stage] = int(stage);
  }

  PD_HD bool active() const { return stage != FrictionStage::done; }
  // whether a launch may end here: the vectors of an iteration are not kept
  PD_HD bool may_pause() const { return stage != FrictionStage::second; }

  PD_HD void scale_by(double factor) {
    product *= factor * factor;
    scale *= factor;
  }

  // after the solve of the symmetric part, which took so many products
  PD_HD void begin(int products, int most) {
    products_left = products > most / friction_products ? most : friction_products * products;
    error = HUGE_VAL;
    stage = FrictionStage::residual;
  }

  // Checks the residual of y with its correction by its |r|^2; returns whether the correction is added.
  PD_HD bool accept(double square, double tolerance) {
    const double found = sqrt(square) / scale;
    const bool better = found < error;
    const bool again =
        2 * found < error && found > friction_enough * tolerance && products_left > 0;
    stage = again ? FrictionStage::first : FrictionStage::done;
    if (better) error = found;
    product = square;
    return better;
  }

  // step length along z = M p, from s . A z; s is the first residual of the cycle
  PD_HD double search_step(double along) {
    step = product / along;
    const bool finite = step < HUGE_VAL && step > -HUGE_VAL;
    stage = finite ? FrictionStage::second : FrictionStage::residual;
    --products_left;
    return step;
  }

  // step length along z = M r, from A z . r and |A z|^2
  PD_HD double residual_step(double along, double square) {
    weight = square > 0 ? along / square : 0;
    return weight;
  }

  // checks the recurrences' residual by |r|^2 and s . r; returns the factor of p in the next p
  PD_HD double finish_iteration(double square, double next, double tolerance) {
    const double residual = sqrt(square), keep = (next / product) * (step / weight);
    const bool finite = residual < HUGE_VAL && keep < HUGE_VAL && keep > -HUGE_VAL && keep != 0;
    --products_left;
    const bool goes_on = finite && residual > tolerance * scale && products_left > 0;
    stage = goes_on ? FrictionStage::first : FrictionStage::residual;
    product = next;
    return keep;
  }
};

// Whether BiCGStab follows the solve of the symmetric part.
PD_HD bool continues_with_friction(const Conjugate& symmetric, double tolerance) {
  return !symmetric.active && symmetric.scale > 0 && symmetric.error <= adjoint_failed * tolerance;
}

// G^T z at a vertex; `p`: its vectors, see Slide.
template <class T>
PD_HD Vec3<T> transposed_friction(const Vec3<T>& z, const T* p) {
  const T *along = p + 3 * slide_along, *normal = p + 3 * slide_normal;
  return multiply_add(dot(Vec3<T>{along[0], along[1], along[2]}, z),
                      Vec3<T>{normal[0], normal[1], normal[2]}, z);
}

template <class T>
PD_HD bool slides(const T* p) {
  const T* along = p + 3 * slide_along;
  return along[0] != T(0) || along[1] != T(0) || along[2] != T(0);
}

// A z at a vertex; `elastic`: K G^T z there.
template <class T>
PD_HD Vec3<T> friction_image(const Vec3<T>& elastic, const Vec3<T>& z, T inertia, bool moves,
                             const T* projector, const T* p) {
  if (!moves) return {T(0), T(0), T(0)};
  const auto vector = [&](int number) {
    return Vec3<T>{p[3 * number], p[3 * number + 1], p[3 * number + 2]};
  };
  const Vec3<T> across = vector(slide_across), bend = vector(slide_bend);
  const T turned = dot(across, z);
  Vec3<T> image = multiply_add(inertia, z, elastic);
  image = multiply_add(turned, across, image);
  image = subtract_product(image, dot(bend, z), bend);
  image = subtract_product(image, turned, vector(slide_lean));
  return project(image, projector);
}

}  // namespace pd::inline PD_TARGET
