// The adjoint of a rollout on either device: one step's adjoint after another, backwards through the recorded states.
#pragma once
#include "binding/adjoint_ops.h"

#include <cstdint>
#include <vector>

namespace pd {

// The material at one step of a rollout: spheres move on.
inline std::vector<Tensor> material_at(at::TensorList material, std::int64_t step) {
  std::vector<Tensor> at_step(material.begin(), material.end());
  Tensor& spheres = at_step[place_in_material("spheres")];
  if (spheres.numel() == 0) return at_step;
  const Tensor center = spheres.narrow(-1, spheres_center, 3);
  const Tensor rest = spheres.narrow(-1, 3, spheres_numbers - 3);
  spheres = at::cat({center + double(step) * spheres.narrow(-1, spheres_motion, 3), rest}, -1);
  return at_step;
}

// Gradient for the spheres at the start of the rollout, from the one at a step.
inline Tensor at_rollout_start(const Tensor& gradient, std::int64_t step) {
  const Tensor center = gradient.narrow(-1, spheres_center, 3);
  const Tensor rest = gradient.narrow(-1, 0, spheres_motion);
  return at::cat({rest, gradient.narrow(-1, spheres_motion, 3) + double(step) * center}, -1);
}

// Checks a record of every step: [step, batch, vertex, 3], with as many steps as `after` has.
inline void check_track(const Tensor& t, const Tensor& positions, const Tensor& after,
                        const char* name, const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == positions.scalar_type(), name, " must be ",
                   at::toString(positions.scalar_type()), " like positions (", meaning, "), got ",
                   describe(t));
  TORCH_CHECK_VALUE(
      t.dim() == 4 && t.sizes().slice(1) == positions.sizes() && t.size(0) == after.size(0), name,
      " must be [step, batch, vertex, 3] (", meaning,
      "), as many steps as after has and each like positions ", positions.sizes(), ", got ",
      describe(t));
  TORCH_CHECK_VALUE(t.device() == positions.device(), name, " must be on ",
                    positions.device().str(), " like positions (", meaning, "), got ", describe(t));
}

inline Tensor zeros_for(const Tensor& t) { return at::zeros(t.sizes(), t.options()); }

// Gradients for the first positions and velocities and for the constant forces, [batch, vertices, 3] each; then for
// the `wanted` arrays of the material, or all. `after` and `after_velocities` are the recorded states, every one.
template <class Backend>
std::vector<Tensor> rollout_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                                const Tensor& after, const Tensor& after_velocities,
                                const Tensor& positions, const Tensor& velocities,
                                const OptionalTensor& forces, at::TensorList material,
                                at::TensorList plan, double time_step, const Wanted& wanted) {
  check_positions(positions, "positions");
  check_state(velocities, positions, "velocities", "m/s");
  if (forces) check_state(*forces, positions, "forces", "N");
  check_track(after, positions, after, "after", "m");
  check_track(after_velocities, positions, after, "after_velocities", "m/s");
  check_track(grad_positions, positions, after, "grad_positions", "of a loss, 1/m");
  check_track(grad_velocities, positions, after, "grad_velocities", "of a loss, 1/(m/s)");
  CheckSetting::time_step(time_step);
  check_material_size(material);
  check_wanted(wanted, material.size(), "rollout_vjp");
  const std::size_t spheres = place_in_material("spheres");
  const auto wants = [&](std::size_t i) { return !wanted || wanted->get(i); };
  Tensor grad_x = zeros_for(positions), grad_v = zeros_for(positions);
  // for forces, then for the wanted arrays
  std::vector<Tensor> sums{zeros_for(positions)};
  std::size_t sphere_place = 1;
  for (std::size_t i = 0; i < material.size(); ++i) {
    if (i < spheres && wants(i)) ++sphere_place;
    if (wants(i)) sums.push_back(zeros_for(material[i]));
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
      sums[i] += i == sphere_place && wants(spheres) ? at_rollout_start(value, step) : value;
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
