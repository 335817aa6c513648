#include "plan/mesh/rest_shape.h"

#define PD_NO_FMA
#include "math/svd.h"

#include <cmath>

namespace pd {

namespace {

Vec3<double> row_of(const double* positions, std::int64_t vertex) {
  const double* x = positions + 3 * vertex;
  return {x[0], x[1], x[2]};
}

// S^T S of the normalised gradients S, whose nonzero eigenvalues are those of S S^T.
Mat3<double> normal_matrix(std::span<const std::array<double, 3>> gradients) {
  Mat3<double> sum = {};
  for (const auto& g : gradients) {
    const Vec3<double> n = {g[0], g[1], g[2]};
    if (dot(n, n) == 0) continue;
    const Vec3<double> unit = (1 / std::sqrt(dot(n, n))) * n;
    sum = {{sum.row[0] + unit.x * unit, sum.row[1] + unit.y * unit, sum.row[2] + unit.z * unit}};
  }
  return sum;
}

// Largest eigenvalues of symmetric positive semidefinite 3x3 matrices, by Newton's method on the characteristic
// polynomial, starting above at its trace. Near a multiple root that loses up to two thirds of the digits; there the
// singular values replace it. Several matrices at once, since each step waits for a division.
template <std::size_t Lanes>
std::array<double, Lanes> largest_eigenvalues(const std::array<Mat3<double>, Lanes>& a) {
  std::array<double, Lanes> trace, minors, det, largest;
  std::array<bool, Lanes> goes_on;
  for (std::size_t i = 0; i < Lanes; ++i) {
    const Mat3<double> c = cofactor(a[i]);
    trace[i] = a[i].row[0].x + a[i].row[1].y + a[i].row[2].z;
    minors[i] = c.row[0].x + c.row[1].y + c.row[2].z;
    det[i] = dot(a[i].row[0], c.row[0]);
    largest[i] = trace[i];
    goes_on[i] = true;
  }
  bool any = true;
  for (int step = 0; step < 100 && any; ++step) {
    any = false;
    for (std::size_t i = 0; i < Lanes; ++i) {
      const double l = largest[i];
      const double p = ((l - trace[i]) * l + minors[i]) * l - det[i];
      const double slope = (3 * l - 2 * trace[i]) * l + minors[i];
      const double change = slope > 0 ? p / slope : 0;
      largest[i] = goes_on[i] ? l - change : l;
      goes_on[i] = goes_on[i] & (change > 1e-15 * trace[i]);
      any = any | goes_on[i];
    }
  }
  for (std::size_t i = 0; i < Lanes; ++i) {
    const double l = largest[i];
    const bool simple = (3 * l - 2 * trace[i]) * l + minors[i] > 0.01 * trace[i] * trace[i];
    if (!simple) largest[i] = signed_svd(a[i]).s[0];
  }
  return largest;
}

}  // namespace

RestShape rest_shape(const double* positions, const std::array<std::int64_t, 4>& tet) {
  const auto at = [&](int k) { return row_of(positions, tet[k]); };
  const Mat3<double> dm = from_columns(at(1) - at(0), at(2) - at(0), at(3) - at(0));
  const Mat3<double> adjoint = transpose(cofactor(dm));
  const double det = dot(dm.row[0], cofactor(dm).row[0]);
  const Mat3<double> inverse = (1 / det) * adjoint;
  const Vec3<double>(&n)[3] = inverse.row;
  return {{n[0].x, n[0].y, n[0].z, n[1].x, n[1].y, n[1].z, n[2].x, n[2].y, n[2].z}, det / 6};
}

std::array<std::array<double, 3>, 4> RestShape::gradients() const {
  const auto& n = inverse;
  return {{{-((n[0] + n[3]) + n[6]), -((n[1] + n[4]) + n[7]), -((n[2] + n[5]) + n[8])},
           {n[0], n[1], n[2]},
           {n[3], n[4], n[5]},
           {n[6], n[7], n[8]}}};
}

std::array<double, bound_lanes> tet_bounds(const std::array<RestShape, bound_lanes>& shapes) {
  std::array<Mat3<double>, bound_lanes> matrices;
  for (std::size_t i = 0; i < bound_lanes; ++i) matrices[i] = normal_matrix(shapes[i].gradients());
  return largest_eigenvalues(matrices);
}

template <std::size_t Corners>
std::array<double, 3 * (Corners - 2)> face_rest(const double* positions,
                                                const std::array<std::int64_t, Corners>& vertex) {
  const auto edge = [&](int c) {
    return row_of(positions, vertex[c]) - row_of(positions, vertex[0]);
  };
  const Vec3<double> first = edge(1), second = edge(2), normal = cross(first, second);
  const double length = std::sqrt(dot(first, first)), area = std::sqrt(dot(normal, normal));
  const double p = 1 / length, q = -dot(first, second) / (length * area), r = length / area;
  std::array<double, 3 * (Corners - 2)> rest = {p, q, r};
  for (int c = 3; c < int(Corners); ++c) {
    // coordinates of the apex along the axes of the face
    const Vec3<double> apex = edge(c);
    const double along = dot(first, apex) / length;
    const double across = dot(cross(normal, first), apex) / (area * length);
    const double h = area / dot(normal, apex);
    double* column = &rest[3 * (c - 2)];
    column[0] = -h * (p * along + q * across);
    column[1] = -h * r * across;
    column[2] = h;
  }
  return rest;
}

template std::array<double, 6> face_rest(const double*, const std::array<std::int64_t, 4>&);
template std::array<double, 9> face_rest(const double*, const std::array<std::int64_t, 5>&);

double element_bound(std::span<const std::array<double, 3>> gradients) {
  return largest_eigenvalues<1>({normal_matrix(gradients)})[0];
}

}  // namespace pd
