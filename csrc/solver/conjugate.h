// Conjugate gradients (Hestenes and Stiefel 1952) on H l = b, H = P (a + K) P with the elastic Hessian K, preconditioned by 1 / D.
//
// P leaves out vertices that do not move, and of others what contacts do not let through. D is one number a vertex, so P and
// 1 / D commute, and all vectors stay where P leaves them.
#pragma once
#include "math/mat.h"
#include "plan/views.h"

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

  // what they are of a right side so many times as large
  PD_HD void scale_by(double factor) {
    product *= factor * factor;
    scale *= factor;
  }

  // by |b|^2, plus zero times every position, and b . b / D
  PD_HD void begin(double square, double weighted) {
    scale = sqrt(square);
    product = weighted;
    active = scale > 0;
    error = active ? 1 : scale;
  }

  // how far to go along the direction; along one without positive curvature H is not positive, and what there is stays
  PD_HD double step(double curvature) {
    active = curvature > 0;
    return active ? product / curvature : 0;
  }

  // what of the last direction the next one keeps
  PD_HD double keep(double residual_square, double next, double tolerance) {
    const double ratio = next / product;
    product = next;
    const double residual = sqrt(residual_square);
    active = residual > tolerance * scale;
    // what got lost on the way is an error, however large
    error = residual < HUGE_VAL ? residual / scale : HUGE_VAL;
    return ratio;
  }
};

// P (a d + K d) of a vertex; `moves`: it has any part in P. `projector`: nine numbers, or null.
template <class T>
PD_HD Vec3<T> conjugate_image(const Vec3<T>& elastic, const Vec3<T>& direction, T inertia,
                              bool moves, const T* projector) {
  if (!moves) return {T(0), T(0), T(0)};
  const Vec3<T> image = multiply_add(inertia, direction, elastic);
  if (!projector) return image;
  const T* p = projector;
  return Mat3<T>{{{p[0], p[1], p[2]}, {p[3], p[4], p[5]}, {p[6], p[7], p[8]}}} * image;
}

}  // namespace pd::inline PD_TARGET
