#include "plan/mesh/stencils.h"

#include "plan/mesh/rest_shape.h"

#define PD_NO_FMA
#include "math/vec.h"

#include <array>
#include <cmath>

namespace pd {

namespace {

using Vector = Vec3<double>;

// g_a of stencil `s`, padded with zeros
Vector gradient_of(const StencilGroup& group, std::int64_t s, int a) {
  const double* g = group.gradient + (s * group.corners + a) * group.dims;
  return {g[0], group.dims > 1 ? g[1] : 0, group.dims > 2 ? g[2] : 0};
}

Vector unit(const Vector& a) { return (1 / std::sqrt(dot(a, a))) * a; }

// The direction of `a` without its parts along orthonormal axes, the last of which are known. The second round removes
// what the first leaves where `a` is almost along them.
Vector axis_along(Vector a, const std::array<Vector, 3>& axes, int known_from, int dims) {
  for (int round = 0; round < 2; ++round) {
    for (int k = known_from; k < dims; ++k) a = a - dot(axes[k], a) * axes[k];
    a = unit(a);
  }
  return a;
}

}  // namespace

int stored_gradient_numbers(const StencilGroup& group) {
  if (group.keeps_axes) return group.dims * (group.corners - 1);
  return group.dims * (group.corners - group.dims) + group.dims * (group.dims - 1) / 2;
}

std::vector<double> stored_gradients(const StencilGroup& group, std::int64_t s) {
  const int n = group.corners, d = group.dims;
  if (d == 1 || group.keeps_axes) {
    std::vector<double> numbers;
    for (int j = 0; j < d; ++j) {
      for (int a = 1; a < n; ++a) numbers.push_back(group.gradient[(s * n + a) * d + j]);
    }
    return numbers;
  }
  // Axis d - 1 along the last vector, axis d - 2 in the plane of the last two, and so on: Gram and Schmidt backwards.
  std::array<Vector, 3> axes = {};
  for (int j = d - 1; j >= 0; --j)
    axes[j] = axis_along(gradient_of(group, s, n - d + j), axes, j + 1, d);
  // a rotation, not a mirror, which would turn an inverted element around
  if (d == 3 && dot(cross(axes[0], axes[1]), axes[2]) < 0) axes[0] = -axes[0];
  std::vector<double> numbers;
  for (int j = 0; j < d; ++j) {
    for (int a = 0; a < n - d + j; ++a)
      numbers.push_back(dot(axes[j], gradient_of(group, s, a + 1)));
  }
  return numbers;
}

double stencil_bound(const StencilGroup& group, std::int64_t s) {
  std::vector<std::array<double, 3>> gradients;
  for (int a = 0; a < group.corners; ++a) {
    const Vector g = gradient_of(group, s, a);
    gradients.push_back({g.x, g.y, g.z});
  }
  return element_bound(gradients);
}

}  // namespace pd
