// The adjoint of a rollout on either device: backwards through the recorded states, one adjoint of a step after another.
#pragma once
#include "adjoint_ops.h"

#include <cstdint>
#include <vector>

namespace pd {

// The material at one step of a rollout: spheres move on.
inline std::vector<Tensor> material_at(at::TensorList material, std::int64_t step) {
  std::vector<Tensor> at_step(material.begin(), material.end());
  Tensor& spheres = at_step[place_in_material("spheres")];
  if (spheres.numel() == 0) return at_step;
  const Tensor center = spheres.narrow(-1, 0, 3), rest = spheres.narrow(-1, 3, 5);
  spheres = at::cat({center + double(step) * spheres.narrow(-1, 5, 3), rest}, -1);
  return at_step;
}

// Of spheres at a step, seen from the start of the rollout.
inline Tensor moved_back(const Tensor& gradient, std::int64_t step) {
  const Tensor center = gradient.narrow(-1, 0, 3), rest = gradient.narrow(-1, 0, 5);
  return at::cat({rest, gradient.narrow(-1, 5, 3) + double(step) * center}, -1);
}

// States one after another, [records, batch, vertices, 3].
inline void check_track(const Tensor& t, const Tensor& positions, const Tensor& like,
                        const char* name, const char* meaning) {
  TORCH_CHECK_VALUE(t.dim() == 4 && t.sizes().slice(1) == positions.sizes(), name,
                    " must be [step, batch, vertex, 3] (", meaning, ") of positions ",
                    positions.sizes(), ", got ", describe(t));
  check_state(t, like, name, meaning);
}

// Gradients for the first positions and velocities, for the forces of all steps, [batch, vertices, 3] each, then for the wanted
// arrays of the material, else all. `after` and `after_velocities` are what the rollout recorded, every state.
template <class Backend>
std::vector<Tensor> rollout_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                                const Tensor& after, const Tensor& after_velocities,
                                const Tensor& positions, const Tensor& velocities,
                                const OptionalTensor& forces, at::TensorList material,
                                at::TensorList plan, double time_step, const Wanted& wanted) {
  check_positions(positions, "positions");
  TORCH_CHECK_TYPE(after.scalar_type() == positions.scalar_type(), "after must be ",
                   at::toString(positions.scalar_type()), " like positions (m), got ",
                   describe(after));
  check_track(after, positions, after, "after", "m");
  check_track(after_velocities, positions, after, "after_velocities", "m/s");
  check_track(grad_positions, positions, after, "grad_positions", "of a loss, 1/m");
  check_track(grad_velocities, positions, after, "grad_velocities", "of a loss, 1/(m/s)");
  TORCH_CHECK_VALUE(material.size() == material_arrays, "rollout_vjp: material must have ",
                    material_arrays, " arrays, got ", material.size());
  check_wanted(wanted, material.size(), "rollout_vjp");
  const std::size_t spheres = place_in_material("spheres");
  const auto wants = [&](std::size_t i) { return !wanted || wanted->get(i); };
  Tensor grad_x = at::zeros_like(positions), grad_v = at::zeros_like(positions);
  // of forces, then of the wanted arrays
  std::vector<Tensor> sums{at::zeros_like(positions)};
  std::size_t sphere_place = 1;
  for (std::size_t i = 0; i < material.size(); ++i) {
    if (i < spheres && wants(i)) ++sphere_place;
    if (wants(i)) sums.push_back(at::zeros_like(material[i]));
  }
  for (std::int64_t step = after.size(0) - 1; step >= 0; --step) {
    std::vector<Tensor> values = step_vjp<Backend>(
        grad_x + grad_positions[step], grad_v + grad_velocities[step], after[step],
        step ? after[step - 1] : positions, step ? after_velocities[step - 1] : velocities, forces,
        material_at(material, step), plan, time_step, wanted);
    grad_x = values[0];
    grad_v = values[1];
    for (std::size_t i = 0; i < sums.size(); ++i) {
      const Tensor& value = values[i + 2];
      sums[i] += i == sphere_place && wants(spheres) ? moved_back(value, step) : value;
    }
  }
  std::vector<Tensor> found{grad_x, grad_v};
  found.insert(found.end(), sums.begin(), sums.end());
  return found;
}

template <class Backend>
void register_adjoint_ops(torch::Library& m) {
  m.impl("adjoint_system", &adjoint_system<Backend>);
  m.impl("contact_gradients", &contact_gradients<Backend>);
  m.impl("adjoint_result", &adjoint_result<Backend>);
  m.impl("conjugate_gradients", &conjugate_gradients<Backend>);
  m.impl("step_vjp", &step_vjp<Backend>);
  m.impl("rollout_vjp", &rollout_vjp<Backend>);
}

}  // namespace pd
