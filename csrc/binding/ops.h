// Common parts of the ops on either device: checks, views, one call of the backend.
//
// A Backend has `Plan<T>`, the plan that its kernels read, and `plan_view<T>(arrays, place)`. `Step<T>`, `Field<T>` and
// `Conjugate<T>` are its calls with effects; `view_stencils(call, arrays, place)` adds the stencils of the plan to one,
// and `stencil_counts(call)` is their number of each kind, null without any. `sums_tets`: whether Field::effect_energy
// counts tetrahedra; `has_stencils(plan)`: whether there is more to count. Its functions `step`, `report`, `field`,
// `precondition`, `conjugate` and `rotation` run a call on the device of the tensor they are given.
#pragma once
#include "binding/checks.h"
#include "binding/conjugate_ops.h"
#include "binding/field_ops.h"
#include "binding/material_views.h"
#include "binding/plan_views.h"
#include "binding/settings.h"
#include "views/views.h"

#include <ATen/ATen.h>
#include <torch/library.h>

#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

namespace pd {

using Outputs = std::tuple<Tensor, Tensor, Tensor>;

struct StepTensors {
  Tensor positions, velocities;
  OptionalTensor forces, start;
  at::TensorList material, plan;
  Tensor out_positions, out_velocities, info;
};

template <class Backend, class T>
void step_typed(const StepTensors& t, const Settings& settings) {
  typename Backend::template Step<T> call;
  const Place place{t.positions.device()};
  call.plan = Backend::template plan_view<T>(t.plan, place);
  Backend::view_stencils(call, t.plan, place);
  call.batch = t.positions.size(0);
  check_vertices(t.positions, call.plan.vertices);
  check_levels(call.plan, settings.multilevel());
  call.material = material_view<T>(call.plan, t.material, call.batch, place);
  call.effects =
      effects_view<T>(Backend::stencil_counts(call), call.plan.tets, t.material, call.batch, place);
  call.effects.stiffness = call.material.stiffness;
  check_tets(t.material[0], call.plan.tets);
  call.settings = settings;
  const Tensor x = t.positions.contiguous(), v = t.velocities.contiguous();
  const Tensor f = t.forces ? t.forces->contiguous() : Tensor(),
               s = t.start ? t.start->contiguous() : Tensor();
  call.positions = x.const_data_ptr<T>();
  call.velocities = v.const_data_ptr<T>();
  call.forces = f.defined() ? f.const_data_ptr<T>() : nullptr;
  call.start = s.defined() ? s.const_data_ptr<T>() : nullptr;
  call.out_positions = t.out_positions.mutable_data_ptr<T>();
  call.out_velocities = t.out_velocities.mutable_data_ptr<T>();
  call.info = t.info.mutable_data_ptr<double>();
  if (call.batch > 0 && settings.steps > 0) Backend::step(call, t.positions);
}

template <class Backend>
void run_step(const StepTensors& t, const Settings& settings) {
  check_positions(t.positions, "positions");
  check_state(t.velocities, t.positions, "velocities", "m/s");
  if (t.forces) check_state(*t.forces, t.positions, "forces", "N");
  if (t.start) check_state(*t.start, t.positions, "start", "first iterate, m");
  if (t.positions.scalar_type() == at::kFloat) {
    step_typed<Backend, float>(t, settings);
  } else {
    step_typed<Backend, double>(t, settings);
  }
}

inline Tensor info_for(const Tensor& positions, at::IntArrayRef records) {
  std::vector<std::int64_t> shape(records.begin(), records.end());
  shape.push_back(positions.size(0));
  shape.push_back(info_count);
  return at::empty(shape, positions.options().dtype(at::kDouble));
}

// Fills in the fields that a step of one record leaves blank, see binding/step_report.h.
template <class Backend>
void report_step(const StepTensors& taken, const Numbers& n, const Tensor* contact = nullptr);

// A rollout with reports, step by step where they are recorded, see binding/step_report.h.
template <class Backend>
void report_rollout(const StepTensors& t, const Numbers& n, const Settings& settings);

template <class Backend>
Outputs step(const Numbers& n, const Tensor& positions, const Tensor& velocities,
             const OptionalTensor& forces, const OptionalTensor& start, at::TensorList material,
             at::TensorList plan) {
  check_positions(positions, "positions");
  const Tensor x = at::empty(positions.sizes(), positions.options()), v = at::empty_like(x);
  const Tensor info = info_for(positions, {});
  const StepTensors tensors{positions, velocities, forces, start, material, plan, x, v, info};
  run_step<Backend>(tensors, settings_of(n, start.has_value(), 1, 1));
  if (n.report) report_step<Backend>(tensors, n);
  return {x, v, info};
}

template <class Backend>
void step_inplace(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                  const Tensor& info, const OptionalTensor& forces, const OptionalTensor& start,
                  at::TensorList material, at::TensorList plan) {
  check_positions(positions, "positions");
  check_inplace(positions, velocities, info);
  // The state is read before it is written: loads and stores of an environment do not overlap in time. Other inputs
  // at the very same place are safe, since blocks wait for each other in iterations. They are copied if there are no
  // iterations, or if they belong to other environments.
  const auto copied = [&](const OptionalTensor& given) {
    if (!given || !(given->is_alias_of(positions) || given->is_alias_of(velocities))) return given;
    const auto is_at = [&](const Tensor& t) {
      return given->const_data_ptr() == t.const_data_ptr();
    };
    const bool same = is_at(positions) || is_at(velocities);
    return same && n.iterations > 0 ? given : OptionalTensor(given->clone());
  };
  // the report needs the state before the step
  const auto kept = [&](const Tensor& t) { return n.report ? t.clone() : t; };
  StepTensors tensors{kept(positions), kept(velocities), copied(forces),
                      copied(start),   material,         plan,
                      positions,       velocities,       info};
  if (n.report && tensors.forces) tensors.forces = tensors.forces->clone();
  run_step<Backend>(tensors, settings_of(n, start.has_value(), 1, 1));
  if (n.report) report_step<Backend>(tensors, n);
  // so that autograd notices a use of overwritten tensors
  for (const Tensor& t : {positions, velocities, info}) {
    if (!t.is_inference()) t.unsafeGetTensorImpl()->bump_version();
  }
}

template <class Backend>
Outputs rollout(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                const OptionalTensor& forces, at::TensorList material, at::TensorList plan,
                std::int64_t steps, std::int64_t every) {
  check_positions(positions, "positions");
  TORCH_CHECK_VALUE(!has_history(material),
                    "rollout must have no plastic solids, whose flow changes after every step, got "
                    "some; call step and then next_history, step by step");
  const Settings settings = settings_of(n, false, steps, every);
  const std::int64_t records = steps / every;
  const Tensor x =
      at::empty({records, positions.size(0), positions.size(1), 3}, positions.options());
  const Tensor v = at::empty_like(x), info = info_for(positions, {records});
  const StepTensors tensors{positions, velocities, forces, {}, material, plan, x, v, info};
  n.report ? report_rollout<Backend>(tensors, n, settings) : run_step<Backend>(tensors, settings);
  return {x, v, info};
}

template <class Backend, class T>
void precondition_typed(const Tensor& field, at::TensorList arrays, const Tensor& out) {
  const auto plan = Backend::template plan_view<T>(arrays, {field.device(), "field"});
  TORCH_CHECK_VALUE(plan.levels.there(),
                    "plan has no multilevel preconditioner; a Simulator with solver=Multilevel() "
                    "or Newton() makes one");
  TORCH_CHECK_VALUE(field.size(1) == plan.vertices, "field must have the ", plan.vertices,
                    " vertices of the plan, got ", describe(field));
  const Tensor from = field.contiguous();
  const PreconditionCall<T> call{plan.levels, plan.vertex_order, field.size(0),
                                 from.const_data_ptr<T>(), out.mutable_data_ptr<T>()};
  if (call.batch > 0) Backend::precondition(call, out);
}

template <class Backend>
Tensor precondition(const Tensor& field, at::TensorList plan) {
  check_real(field, "field", "[batch, vertices, 3] (N)");
  TORCH_CHECK_VALUE(field.dim() == 3 && field.size(2) == 3,
                    "field must be [batch, vertices, 3] (N), got ", describe(field));
  const Tensor out = at::empty(field.sizes(), field.options());
  if (field.scalar_type() == at::kFloat) {
    precondition_typed<Backend, float>(field, plan, out);
  } else {
    precondition_typed<Backend, double>(field, plan, out);
  }
  return out;
}

template <class Backend, class T>
void rotation_typed(const Tensor& matrices, const Tensor& direction, const Tensor& out) {
  const Tensor f = matrices.contiguous(),
               d = direction.defined() ? direction.contiguous() : Tensor();
  const RotationCall<T> call{f.numel() / 9, f.const_data_ptr<T>(),
                             d.defined() ? d.const_data_ptr<T>() : nullptr,
                             out.mutable_data_ptr<T>()};
  if (call.count > 0) Backend::rotation(call, out);
}

template <class Backend>
Tensor run_rotation(const Tensor& matrices, const Tensor& direction) {
  check_matrices(matrices, "matrices");
  if (direction.defined()) check_direction(direction, matrices);
  const Tensor out = at::empty(matrices.sizes(), matrices.options());
  if (matrices.scalar_type() == at::kFloat) {
    rotation_typed<Backend, float>(matrices, direction, out);
  } else {
    rotation_typed<Backend, double>(matrices, direction, out);
  }
  return out;
}

template <class Backend>
Tensor rotations_of(const Tensor& matrices) {
  return run_rotation<Backend>(matrices, {});
}

template <class Backend>
Tensor rotation_differentials_of(const Tensor& matrices, const Tensor& direction) {
  return run_rotation<Backend>(matrices, direction);
}

template <class Backend>
void register_ops(torch::Library& m) {
  m.impl("step", unpacked<&step<Backend>>);
  m.impl("step_", unpacked<&step_inplace<Backend>>);
  m.impl("rollout", unpacked<&rollout<Backend>>);
  m.impl("gradient", &gradient<Backend>);
  m.impl("hessian_product", &hessian_product<Backend>);
  m.impl("element_energy", &element_energy<Backend>);
  m.impl("element_energy_product", &element_energy_product<Backend>);
  m.impl("effect_energy", &effect_energy<Backend>);
  m.impl("lame_product", &lame_product<Backend>);
  m.impl("effect_products", &effect_products<Backend>);
  m.impl("damping_gradient", &damping_gradient<Backend>);
  m.impl("damping_vjp", &damping_vjp<Backend>);
  m.impl("elastic_diagonal", &elastic_diagonal<Backend>);
  m.impl("stiffness_at_rest", &stiffness_at_rest<Backend>);
  m.impl("precondition", &precondition<Backend>);
  m.impl("conjugate_gradients_", &conjugate_gradients_inplace<Backend>);
  m.impl("nearest_rotation", &rotations_of<Backend>);
  m.impl("rotation_differential", &rotation_differentials_of<Backend>);
}

}  // namespace pd

#include "binding/step_report.h"
