// The adjoint of vertices that slide against friction.
//
// Of one contact with normal n, friction mu and slip s against the surface, a solved step has, with the gradient r of its
// objective at the vertex, P = 1 - n n^T and d = s / |s|,
//
//   P r + mu (n . r) d = 0        beside n . x' = const.
//
// The derivative by x' is G H P + kappa Q, G = P + mu d n^T, and Q = 1 - n n^T - d d^T, by which the slip turns, with
// kappa = mu (n . r) / |s|. So for a loss L the multiplier is l = G^T y, where
//
//   A y = P dL/dx',   A = P H G^T + kappa Q,
//
// and dL/dp = -l . dr/dp for all that r depends on; the start of the slip has kappa Q y besides. On a ball of radius R, from
// the centre to the vertex, the normal turns too: P H P less (n . r) / R, as without friction, less mu^2 (n . r) / R along d,
// and kappa Q times 1 - m / R, m the motion along the normal.
//
// Of a vertex between two planes P leaves the edge alone, d lies along it and does not turn, and in place of mu n stands the
// sum of mu_k m_k, the m_k dual to the normals: r is the sum of (m_k . r) n_k. The steps themselves take the friction of a
// plane against the slip before the other has pushed back, which differs by (push / (D |s|))^2 where that one is smooth,
// without the square where both are rough. A vertex that more contacts hold, or a ball and another, counts as frictionless.
//
// A is not symmetric. Conjugate gradients solve its symmetric part P H P + kappa Q first (solver/adjoint/conjugate_gradients.h), and say whether H
// is positive. From there BiCGStab (van der Vorst 1992) goes on, preconditioned alike. It solves for a correction of y, which
// enters where it makes the true residual smaller, and begins again while that halves.
#pragma once
#include "math/mat.h"
#include "solver/adjoint/conjugate_gradients.h"
#include "solver/adjoint/system.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// What an environment does next: a product with A for the residual of y, or one of the two of an iteration of BiCGStab.
enum class FrictionStage : int { done, residual, first, second };

// BiCGStab may take so many products for each of the symmetric part.
constexpr int friction_products = 10;
// The true residual is enough at so many tolerances: rounding keeps it above the residual of the recurrences.
constexpr double friction_enough = 10;

// One environment's numbers between products, as in FrictionProgress. `scale`: |right side|.
struct FrictionSolve {
  double scale, product = 0, error = 0;
  int left = 0;  // products, of the symmetric part before
  FrictionStage stage = FrictionStage::done;
  double step = 0, weight = 0;

  // `from`: null where nothing slides in any environment
  PD_HD FrictionSolve(const double* from, double scale) : scale(scale) {
    if (!from) return;
    product = from[friction_product];
    error = from[friction_error];
    left = int(from[friction_left]);
    stage = FrictionStage(int(from[friction_stage]));
  }

  PD_HD void write(double* to) const {
    to[friction_product] = product;
    to[friction_error] = error;
    to[friction_left] = left;
    to[friction_stage] = int(stage);
  }

  PD_HD bool active() const { return stage != FrictionStage::done; }
  // whether a launch may end here: vectors of an iteration are not kept
  PD_HD bool pauses() const { return stage != FrictionStage::second; }

  PD_HD void scale_by(double factor) {
    product *= factor * factor;
    scale *= factor;
  }

  // after the solve of the symmetric part, which took so many products
  PD_HD void begin(int products, int most) {
    left = products > most / friction_products ? most : friction_products * products;
    error = HUGE_VAL;
    stage = FrictionStage::residual;
  }

  // Judges the residual of y with its correction by its |r|^2; returns whether the correction enters.
  PD_HD bool accept(double square, double tolerance) {
    const double found = sqrt(square) / scale;
    const bool better = found < error;
    const bool again = 2 * found < error && found > friction_enough * tolerance && left > 0;
    stage = again ? FrictionStage::first : FrictionStage::done;
    if (better) error = found;
    product = square;
    return better;
  }

  // how far to go along z = M p, by s . A z, s the first residual of the cycle
  PD_HD double go(double along) {
    step = product / along;
    const bool finite = step < HUGE_VAL && step > -HUGE_VAL;
    stage = finite ? FrictionStage::second : FrictionStage::residual;
    --left;
    return step;
  }

  // how far to go along z = M r, by A z . r and |A z|^2
  PD_HD double smooth(double along, double square) {
    weight = square > 0 ? along / square : 0;
    return weight;
  }

  // judges the residual of the recurrences, by |r|^2 and s . r; returns what the next p keeps of this one
  PD_HD double judge(double square, double next, double tolerance) {
    const double residual = sqrt(square), keep = (next / product) * (step / weight);
    const bool finite = residual < HUGE_VAL && keep < HUGE_VAL && keep > -HUGE_VAL && keep != 0;
    --left;
    const bool goes_on = finite && residual > tolerance * scale && left > 0;
    stage = goes_on ? FrictionStage::first : FrictionStage::residual;
    product = next;
    return keep;
  }
};

// Whether friction follows the solve of the symmetric part, which has ended so.
PD_HD bool adds_friction(const Conjugate& symmetric, double tolerance) {
  return !symmetric.active && symmetric.scale > 0 && symmetric.error <= adjoint_failed * tolerance;
}

// Of the vectors of a vertex that slides, see Slide: G^T z. `p`: them.
template <class T>
PD_HD Vec3<T> press(const Vec3<T>& z, const T* p) {
  const T *along = p + 3 * slide_along, *normal = p + 3 * slide_normal;
  return multiply_add(dot(Vec3<T>{along[0], along[1], along[2]}, z),
                      Vec3<T>{normal[0], normal[1], normal[2]}, z);
}

template <class T>
PD_HD bool slides(const T* p) {
  const T* along = p + 3 * slide_along;
  return along[0] != T(0) || along[1] != T(0) || along[2] != T(0);
}

// A z of a vertex. `elastic`: K G^T z there.
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
