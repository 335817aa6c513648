// Colliders with a mass in the system of a step's adjoint: two vertices each, which no element has. Their terms are in
// solver/adjoint/rigid_nodes.h.
#pragma once
#include "binding/adjoint_ops.h"
#include "contact/views.h"

#include <cstddef>
#include <cstdint>
#include <string_view>
#include <vector>

namespace pd {

// The arrays of a plan without levels, and with vertices that have no element. On a CPU each is in a slot of its own.
inline std::vector<Tensor> plan_with_more(at::TensorList plan, std::int64_t more, bool on_gpu) {
#define X(name, type, width, rows, meaning) #rows,
  static constexpr std::string_view of_cpu[] = {
#include "views/cpu_plan.def"
  };
  static constexpr std::string_view of_gpu[] = {
#include "views/gpu_plan.def"
  };
#undef X
  const std::size_t own = on_gpu ? std::size(of_gpu) : std::size(of_cpu);
  const std::size_t stencils = std::size_t(on_gpu ? device_stencil_arrays : stencil_arrays);
  const bool mixed = plan.size() == own + stencils || plan.size() == own + stencils + level_arrays;
  std::vector<Tensor> wide(plan.begin(), plan.begin() + own + (mixed ? stencils : 0));
  wide[0] = plan[0].clone();
  int32* const size = wide[0].mutable_data_ptr<int32>();
  int32 &vertices = size[on_gpu ? int(size_vertices) : int(plan_vertices)],
        &shared = size[on_gpu ? int(size_shared) : int(plan_shared)],
        &slots = size[on_gpu ? int(size_slots) : int(plan_slots)];
  const std::int64_t first = vertices, first_slot = slots, ends = first_slot - (vertices - shared);
  const auto append = [&](Tensor& array, std::int64_t from, bool counts) {
    const Tensor added = counts ? at::arange(from, from + more, array.options())
                                : at::full({more}, from, array.options());
    array = at::cat({array.flatten(), added});
  };
  constexpr std::size_t vertex_order = 1;  // of every plan
  for (std::size_t n = 1; n < own; ++n) {
    const std::string_view rows = on_gpu ? of_gpu[n] : of_cpu[n];
    if (rows == "vertex") append(wide[n], n == vertex_order ? first : -1, n == vertex_order);
    if (rows == "pinned_vertex" && wide[n].numel() > 0) append(wide[n], -1, false);
    if (rows == "shared_end") append(wide[n], on_gpu ? ends : ends + 1, !on_gpu);
    if (on_gpu) continue;
    if (rows == "slot") append(wide[n], first, true);
    if (rows == "shared_slot") append(wide[n], first_slot, true);
  }
  vertices += int32(more);
  shared += int32(more);
  if (!on_gpu) slots += int32(more);
  return wide;
}

// The rows of colliders that leave their free motion; zeros for others, which do not move. [batch, 2 colliders, ...]
struct RigidSystem {
  Tensor right, inertia, inverse;

  // `rows`: masses [batch, colliders, 13]; poses [batch, colliders, 7]: free ones, those after the step, and the gradient
  // by these. A pose moves by t + w x (o - c) and half of w times its quaternion.
  RigidSystem(const Tensor& rows, const Tensor& free, const Tensor& after, const Tensor& grad,
              const Tensor& taken_back) {
    const Tensor weight = rows.select(-1, 0);
    const Tensor moves =
        weight.gt(0).logical_and(free.ne(after).any(-1)).logical_and(taken_back.logical_not());
    const auto number = [](const Tensor& of, int n) { return of.narrow(-1, n, 1); };
    const auto vector = [](const Tensor& of, int n) { return of.narrow(-1, n, 3); };
    const auto cross = [](const Tensor& a, const Tensor& b) { return at::linalg_cross(a, b); };
    const Tensor w = number(after, 3), axis = vector(after, 4), center = vector(rows, 1),
                 across = 2.0 * cross(axis, center),
                 arm = center + w * across + cross(axis, across), force = vector(grad, 0),
                 by_axis = vector(grad, 4);
    const Tensor torque =
        0.5 * (w * by_axis - number(grad, 3) * axis + cross(axis, by_axis)) - cross(arm, force);
    const Tensor moments = number(rows, 4) + number(rows, 7) + number(rows, 9);
    const Tensor size = (0.5 * moments / weight.unsqueeze(-1)).sqrt();
    const auto both = [&](const Tensor& shift, const Tensor& turn) {
      const Tensor some = moves.view({moves.size(0), moves.size(1), 1, 1});
      return at::where(some, at::stack({shift, turn}, 2), 0.0).flatten(1, 2);
    };
    const Tensor inverse_weight = weight.reciprocal().unsqueeze(-1);
    right = both(force, torque / size);
    inertia = both(weight.unsqueeze(-1), at::zeros_like(inverse_weight)).squeeze(-1);
    inverse = both(inverse_weight, inverse_weight).squeeze(-1);
  }
};

}  // namespace pd
