// Conjugate gradients (Hestenes and Stiefel 1952) on H l = b, H = P (a + K) P with the elastic Hessian K. The
// preconditioner is 1 / D, or P M P where the plan has levels, with 1 / D on vertices that M does not know. Where
// vertices slide against friction, H has the term of the slip's rotation too (slide_across).
//
// P removes vertices that do not move, and the directions that contacts block. D is one number a vertex, so P and 1 /
// D commute, and all vectors stay in the range of P.
#pragma once
#include "math/mat.h"
#include "views/views.h"

#include <limits>

namespace pd::inline PD_TARGET {

// One environment's numbers between iterations, as in ConjugateProgress.
struct Conjugate {
  double product, scale, error;
  bool active, begins;

  PD_HD explicit Conjugate(const double* from)
      : product(from[progress_product]),
        scale(from[progress_scale]),
        error(from[progress_error]),
        active(from[progress_active] != 0),
        begins(from[progress_active] < 0) {}

  PD_HD void write(double* to) const {
    to[progress_product] = product;
    to[progress_scale] = scale;
    to[progress_active] = active ? 1 : 0;
    to[progress_error] = error;
  }

  // rescales for a right side so many times as large
  PD_HD void scale_by(double factor) {
    product *= factor * factor;
    scale *= factor;
  }

  // Takes |b|^2, plus zero times every position, and b . z with z = b / D or M b.
  PD_HD void begin(double square, double weighted) {
    scale = sqrt(square);
    product = weighted;
    active = scale > 0;
    error = active ? 1 : scale;
  }

  // step length along the direction. Negative curvature means that H is not positive: the solve stops with what it
  // has.
  PD_HD double step(double curvature) {
    active = curvature > 0;
    return active ? product / curvature : 0;
  }

  // whether the residual r needs more iterations, by |r|^2
  PD_HD void check_residual(double square, double tolerance) {
    const double residual = sqrt(square);
    active = residual > tolerance * scale;
    // a NaN on the way is an error, however large
    error = residual < HUGE_VAL ? residual / scale : HUGE_VAL;
  }

  // factor of the last direction in the next one (beta), from r . z
  PD_HD double direction_ratio(double next) {
    const double ratio = next / product;
    product = next;
    return ratio;
  }
};

// Unit of the solve: a power of two near the largest number of the residual, so that squares neither overflow nor
// vanish. Both it and its reciprocal are finite, normal numbers.
template <class T>
PD_HD T unit_near(T largest) {
  if (!(largest > T(0) && largest < T(HUGE_VAL))) return T(1);
  constexpr int most = std::numeric_limits<T>::max_exponent - 3;
  const int exponent = ilogb(double(largest));
  return T(ldexp(1.0, exponent > most ? most : exponent < -most ? -most : exponent));
}

// Projects a field on the free directions. `projector`: nine numbers, or null.
template <class T>
PD_HD Vec3<T> project(const Vec3<T>& field, const T* p) {
  if (!p) return field;
  return Mat3<T>{{{p[0], p[1], p[2]}, {p[3], p[4], p[5]}, {p[6], p[7], p[8]}}} * field;
}

// P (a d + K d) at a vertex; `moves`: P leaves it any direction. `across`: slide_across, whose outer product H has;
// or null.
template <class T>
PD_HD Vec3<T> conjugate_image(const Vec3<T>& elastic, const Vec3<T>& direction, T inertia,
                              bool moves, const T* projector, const T* across) {
  if (!moves) return {T(0), T(0), T(0)};
  Vec3<T> image = multiply_add(inertia, direction, elastic);
  if (across) {
    const Vec3<T> turning = {across[0], across[1], across[2]};
    image = multiply_add(dot(turning, direction), turning, image);
  }
  return project(image, projector);
}

// z at a vertex with residual r: P M r, or r / D if M holds the vertex. `of_levels`: (M r) there.
template <class T>
PD_HD Vec3<T> preconditioned(const Vec3<T>& of_levels, const Vec3<T>& residual, T inverse,
                             T reference_inertia, const T* projector) {
  const bool known = inverse != T(0) && reference_inertia < T(HUGE_VAL);
  return known ? project(of_levels, projector) : inverse * residual;
}

}  // namespace pd::inline PD_TARGET
