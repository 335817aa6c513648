// Multipliers of contact as one more proximal step of an iteration, in the metric of D.
//
// An iteration takes z = x' - c g / D with c = theta omega. Its contacts choose forces lambda n +
// lambda_t on side A, the opposite on side B. They shift vertex i by c / D_i w_i (lambda n +
// lambda_t). lambda >= 0 and n . sum w z >= r are complementary. lambda_t lies in the disc of
// radius mu lambda, and opposes the slip since the step's start. The fixed point depends neither on
// theta and omega, nor on D.
//
// Each of a few sweeps moves all multipliers at once, by the inverse of a majoriser of c C D^-1
// C^T:
//
//   beta = 1 / (c sum_i |w_i| S_i / D_i),    S_i = sum over active pairs |w_i|
#pragma once
#include "contact/plane_sphere.h"

namespace pd::inline PD_TARGET {

// The force of a pair on its side A [N].
template <class T>
struct Multiplier {
  T normal;            // lambda
  Vec3<T> tangential;  // lambda_t, orthogonal to the normal
};

// The nearest vector of the disc of a radius.
template <class T>
PD_HD Vec3<T> onto_disc(const Vec3<T>& vector, T radius) {
  const T length = square_root(dot(vector, vector));
  const auto outside = length > radius;
  return select(outside, radius / select(outside, length, T(1)), T(1)) * vector;
}

// The multiplier after one sweep. `between`: sum w X of the shifted iterate; `before`: sum w x_t at
// the step's start.
//
//   lambda   <- max(0, lambda + beta (r - n . between))
//   lambda_t <- lambda_t - beta (1 - n n^T) (between - before), onto the disc of radius mu lambda
template <class T>
PD_HD Multiplier<T> advance(const Multiplier<T>& of, T beta, T thickness, T friction,
                            const Vec3<T>& normal, const Vec3<T>& between, const Vec3<T>& before) {
  const T pushed = multiply_add(beta, thickness - dot(normal, between), of.normal);
  const T force = select(pushed < T(0), T(0), pushed);
  const Vec3<T> pull = subtract_product(of.tangential, beta, tangential(between - before, normal));
  return {force, onto_disc(tangential(pull, normal), friction * force)};
}

// The augmented Lagrangian of a pair [J] at a distance d [m] and a slip t [m], by its multiplier
// and friction bound:
//
//   psi = (max(0, q)^2 - lambda^2) / 2k + (huber(|lambda_t - k t|) - |lambda_t|^2 / 2) / k
//   q = lambda + k (r - d),   1 / k = sum w^2 / D
//   huber(y) = y^2 / 2 up to y = mu lambda,   beyond it mu lambda y - (mu lambda)^2 / 2
//
// `yielding` is 1 / k [m/N]; psi is 0 where nothing yields. In double, because the squares of
// forces cancel.
template <class T>
PD_HD double augmented_lagrangian(const Multiplier<T>& of, T yielding, T thickness, T friction,
                                  T distance, const Vec3<T>& slip) {
  if (!(yielding > T(0))) return 0.0;
  const double k = 1.0 / double(yielding), lambda(of.normal);
  const Vec3<double> pull = {double(of.tangential.x), double(of.tangential.y),
                             double(of.tangential.z)};
  const Vec3<double> slid = {double(slip.x), double(slip.y), double(slip.z)};
  const double q = multiply_add(k, double(thickness) - double(distance), lambda);
  const double pushed = select(q < 0.0, 0.0, q);
  const double energy = 0.5 * difference_of_products(pushed, pushed, lambda, lambda) / k;
  const double bound = double(friction) * lambda;
  if (!(bound > 0.0)) return energy;
  const Vec3<double> trial = subtract_product(pull, k, slid);
  const double square = dot(trial, trial), size = square_root(square);
  const double huber =
      select(size > bound, multiply_subtract(bound, size, 0.5 * bound * bound), 0.5 * square);
  return energy + (huber - 0.5 * dot(pull, pull)) / k;
}

}  // namespace pd::inline PD_TARGET
