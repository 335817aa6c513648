// The ops of a step's adjoint on either device. Beside the functions of binding/ops.h, a Backend runs a call by
// `adjoint_system`, `contact_gradients`, `adjoint_result` and `vertex_sum`. `recording(like)` says whether work is
// only recorded for later, so that its results cannot be read.
#pragma once
#include "binding/material_gradients.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

namespace pd {

using AdjointOutputs = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

template <class Backend, class T>
AdjointOutputs adjoint_system_typed(const AdjointTensors& t, double time_step) {
  SolvedStep<Backend, T> step(t, time_step);
  auto& call = step.call;
  const Material<T>& m = call.material;
  const bool own = step.touching || environments_of(t.material).value_or(1) != 1 ||
                   m.masses.stride || m.damping.stride || m.pin_stiffness.stride;
  call.rows = own ? call.batch : 1;
  const std::int64_t vertices = call.plan.vertices;
  const at::TensorOptions options = t.after.options();
  const Tensor right = at::empty(t.after.sizes(), options);
  const Tensor inertia = at::empty({call.rows, vertices}, options);
  const Tensor inverse = at::empty_like(inertia);
  call.right = right.mutable_data_ptr<T>();
  call.inertia = inertia.mutable_data_ptr<T>();
  call.inverse = inverse.mutable_data_ptr<T>();
  const std::int64_t held = step.touching ? call.batch : 0;
  const Tensor projector = at::empty({held, vertices, 3, 3}, options);
  const Tensor stuck = at::empty({held, vertices}, options.dtype(at::kBool));
  const Tensor sliding = at::empty({held, vertices, slide_count, 3}, options);
  if (step.touching) {
    call.projector = projector.mutable_data_ptr<T>();
    call.stuck = stuck.mutable_data_ptr<bool>();
    call.sliding = sliding.mutable_data_ptr<T>();
  }
  if (call.batch > 0) Backend::adjoint_system(call, right);
  return {right, inertia, inverse, projector, stuck, sliding};
}

inline void check_solved_step(const AdjointTensors& t, double time_step) {
  check_positions(t.positions, "positions");
  check_state(t.velocities, t.positions, "velocities", "m/s");
  check_state(t.after, t.positions, "after", "m");
  if (t.forces) check_state(*t.forces, t.positions, "forces", "N");
  check_state(t.grad_positions, t.positions, "grad_positions", "of a loss, 1/m");
  check_state(t.grad_velocities, t.positions, "grad_velocities", "of a loss, 1/(m/s)");
  CheckSetting::time_step(time_step);
}

// The system of a step's adjoint: right side [batch, vertices, 3], inertia and inverse diagonal [batch or 1,
// vertices]. A scene with contacts adds three arrays; else these have no environments:
//   projector [batch, vertices, 3, 3]   off the normals that hold a vertex; if it sticks to a sphere, times its motion per
//                                       motion of its start
//   stuck [batch, vertices]             whether friction holds it
//   sliding [batch, vertices, 5, 3]     its vectors of sliding friction, see Slide
template <class Backend>
AdjointOutputs adjoint_system(const Tensor& grad_positions, const Tensor& grad_velocities,
                              const Tensor& after, const Tensor& positions,
                              const Tensor& velocities, const OptionalTensor& forces,
                              at::TensorList material, at::TensorList plan, double time_step) {
  const AdjointTensors tensors{grad_positions, grad_velocities, after,    positions,
                               velocities,     forces,          material, plan};
  check_solved_step(tensors, time_step);
  return positions.scalar_type() == at::kFloat
             ? adjoint_system_typed<Backend, float>(tensors, time_step)
             : adjoint_system_typed<Backend, double>(tensors, time_step);
}

// Only with contacts: the part of dL/dx' + dL/dv' / h - K l that vertices held by friction pass to their start.
struct HeldTerms {
  OptionalTensor grad_positions, elastic, projector, stuck, sliding;
};

struct ResultTensors {
  Tensor multiplier, error, grad_velocities;
  at::TensorList material;
  HeldTerms held_terms;
};

template <class Backend, class T>
Outputs adjoint_result_typed(const ResultTensors& t, double time_step) {
  AdjointResultCall<T> call;
  const Place place{t.multiplier.device()};
  call.batch = t.multiplier.size(0);
  call.vertices = t.multiplier.size(1);
  call.masses = values_view<T>(array_of(t.material, "masses"), call.vertices, 1, false, call.batch,
                               place, "masses", "kg");
  call.damping = values_view<T>(array_of(t.material, "damping"), 1, 1, true, call.batch, place,
                                "damping", "1/s");
  call.time_step = time_step;
  const Tensor l = t.multiplier.contiguous(), v = t.grad_velocities.contiguous();
  const Tensor x = at::empty_like(l), before = at::empty_like(l), out = at::empty_like(l);
  call.multiplier = l.const_data_ptr<T>();
  call.grad_velocities = v.const_data_ptr<T>();
  call.error = t.error.const_data_ptr<double>();
  call.error_stride = t.error.stride(0);
  call.out_positions = x.mutable_data_ptr<T>();
  call.out_velocities = before.mutable_data_ptr<T>();
  call.out_multiplier = out.mutable_data_ptr<T>();
  Tensor grad_x, elastic, projector, stuck, sliding;
  if (t.held_terms.stuck) {
    grad_x = t.held_terms.grad_positions->contiguous(),
    elastic = t.held_terms.elastic->contiguous();
    projector = t.held_terms.projector->contiguous(), stuck = t.held_terms.stuck->contiguous();
    sliding = t.held_terms.sliding->contiguous();
    call.grad_positions = grad_x.const_data_ptr<T>();
    call.elastic = elastic.const_data_ptr<T>();
    call.projector = projector.const_data_ptr<T>();
    call.stuck = stuck.const_data_ptr<bool>();
    call.sliding = sliding.const_data_ptr<T>();
  }
  if (l.numel() > 0) Backend::adjoint_result(call, l);
  return {x, before, out};
}

// Gradients for positions and velocities before a step, and the multiplier. All are NaN where the error is NaN.
template <class Backend>
Outputs adjoint_result(const Tensor& multiplier, const Tensor& error, const Tensor& grad_velocities,
                       at::TensorList material, const OptionalTensor& grad_positions,
                       const OptionalTensor& elastic, const OptionalTensor& projector,
                       const OptionalTensor& stuck, const OptionalTensor& sliding,
                       double time_step) {
  check_positions(multiplier, "multiplier");
  check_state(grad_velocities, multiplier, "grad_velocities", "of a loss, 1/(m/s)");
  TORCH_CHECK_VALUE(
      error.scalar_type() == at::kDouble && error.dim() == 1 &&
          error.size(0) == multiplier.size(0) && error.device() == multiplier.device(),
      "error must be float64 [", multiplier.size(0), "] beside multiplier, got ", describe(error));
  CheckSetting::time_step(time_step);
  const bool some = grad_positions || elastic || projector || stuck || sliding;
  if (some) {
    TORCH_CHECK_VALUE(
        grad_positions && elastic && projector && stuck && sliding,
        "grad_positions, elastic, projector, stuck and sliding come together or not at all");
    check_state(*grad_positions, multiplier, "grad_positions", "of a loss, 1/m");
    check_state(*elastic, multiplier, "elastic", "Hessian product, N");
    check_projector(*projector, multiplier);
    TORCH_CHECK_VALUE(
        stuck->scalar_type() == at::kBool && stuck->sizes() == multiplier.sizes().slice(0, 2) &&
            stuck->device() == multiplier.device(),
        "stuck must be bool [batch, vertices] beside multiplier, got ", describe(*stuck));
    check_sliding(*sliding, multiplier);
  }
  const ResultTensors tensors{multiplier,
                              error,
                              grad_velocities,
                              material,
                              {grad_positions, elastic, projector, stuck, sliding}};
  return multiplier.scalar_type() == at::kFloat
             ? adjoint_result_typed<Backend, float>(tensors, time_step)
             : adjoint_result_typed<Backend, double>(tensors, time_step);
}

// Gradients of a solved adjoint for planes [batch, planes, 5] and spheres [batch, spheres, 8].
template <class Backend>
std::tuple<Tensor, Tensor> contact_gradients(const Tensor& multiplier, const Tensor& elastic,
                                             const Tensor& grad_positions,
                                             const Tensor& grad_velocities, const Tensor& after,
                                             const Tensor& positions, const Tensor& velocities,
                                             const OptionalTensor& forces, at::TensorList material,
                                             at::TensorList plan, double time_step) {
  const AdjointTensors tensors{grad_positions, grad_velocities, after,    positions,
                               velocities,     forces,          material, plan};
  check_solved_step(tensors, time_step);
  check_state(multiplier, positions, "multiplier", "of a loss, 1/N");
  check_state(elastic, positions, "elastic", "Hessian product, of a loss, 1/m");
  return gradients_for_contacts<Backend>(tensors, multiplier, elastic, time_step);
}

struct AdjointSystem {
  Tensor right, inertia, inverse;
  OptionalTensor projector, sliding;  // with contacts
  at::TensorList pairs = {};          // between bodies, see ConjugateTensors
};

// The multiplier, and relative residuals of every environment: of the symmetric system, and of the one with friction
// (solver/adjoint/friction.h). The latter is 0 where no vertex slides, and undefined without contacts.
struct AdjointSolution {
  Tensor solution, error, friction;
};

// Iterates conjugate_gradients_, then the friction solve, until all environments have ended.
template <class Backend>
AdjointSolution iterate(const Tensor& positions, const AdjointSystem& s, at::TensorList material,
                        at::TensorList plan, double tolerance, const OptionalTensor& start,
                        double time_step) {
  const Tensor right = s.right.contiguous(), x = positions.contiguous();
  const Tensor solution = at::empty_like(right), direction = at::empty_like(right);
  const Tensor residual = right.clone();
  const at::TensorOptions numbers = x.options().dtype(at::kDouble);
  const Tensor progress = at::full({x.size(0), progress_count}, -1.0, numbers);
  const bool rubs = s.sliding || !s.pairs.empty();
  OptionalTensor friction;
  if (rubs) friction = at::zeros({x.size(0), friction_count}, numbers);
  solve_conjugate<Backend>(
      {solution, residual, direction, progress, x, s.inertia, s.inverse, s.projector, material,
       plan, s.sliding, right, friction, start, time_step, s.pairs},
      tolerance, (rubs ? 2 : 1) * adjoint_iterations);
  return {solution, progress.select(1, progress_error),
          friction ? friction->select(1, friction_error) : Tensor()};
}

// The system of a step with the `pairs` of bodies in contact, see ConjugateTensors.
template <class Backend>
std::tuple<Tensor, Tensor> contact_conjugate(const Tensor& positions, const Tensor& right,
                                             const Tensor& inertia, const Tensor& inverse,
                                             const OptionalTensor& projector,
                                             at::TensorList material, at::TensorList plan,
                                             const OptionalTensor& sliding,
                                             const OptionalTensor& start, at::TensorList pairs,
                                             double tolerance, double time_step) {
  check_positions(positions, "positions");
  check_state(right, positions, "right", "N");
  const AdjointSolution found =
      iterate<Backend>(positions, {right, inertia, inverse, projector, sliding, pairs}, material,
                       plan, tolerance, start, time_step);
  return {found.solution, found.friction.defined() ? at::maximum(found.error, found.friction)
                                                   : found.error.contiguous()};
}

template <class Backend>
std::tuple<Tensor, Tensor> conjugate_gradients(const Tensor& positions, const Tensor& right,
                                               const Tensor& inertia, const Tensor& inverse,
                                               const OptionalTensor& projector,
                                               at::TensorList material, at::TensorList plan,
                                               const OptionalTensor& sliding,
                                               const OptionalTensor& start, double tolerance,
                                               double time_step) {
  return contact_conjugate<Backend>(positions, right, inertia, inverse, projector, material, plan,
                                    sliding, start, {}, tolerance, time_step);
}

// The solution with the fallback for failed environments, and the warnings: torchpd/ops/adjoint.py.
inline Tensor apply_fallback(const AdjointTensors& t, const AdjointSystem& s, double time_step,
                             const AdjointSolution& found) {
  const OptionalTensor friction =
      found.friction.defined() ? OptionalTensor(found.friction) : OptionalTensor();
  if (!s.pairs.empty()) {
    static const auto with_pairs =
        find_op<Tensor(const Tensor&, const Tensor&, const OptionalTensor&, const Tensor&,
                       const Tensor&, const Tensor&, const OptionalTensor&, at::TensorList,
                       at::TensorList, const OptionalTensor&, at::TensorList, double)>(
            "torchpd::contact_fallback");
    return with_pairs.call(found.solution, found.error, friction, t.after, s.right, s.inverse,
                           s.projector, t.material, t.plan, start_of(t), s.pairs, time_step);
  }
  static const auto op =
      find_op<Tensor(const Tensor&, const Tensor&, const OptionalTensor&, const Tensor&,
                     const Tensor&, const Tensor&, const OptionalTensor&, at::TensorList,
                     at::TensorList, const OptionalTensor&, double)>("torchpd::adjoint_fallback");
  return op.call(found.solution, found.error, friction, t.after, s.right, s.inverse, s.projector,
                 t.material, t.plan, start_of(t), time_step);
}

// Whether the solve of any environment has failed. One copy waits for a GPU, and takes less time than kernels that
// reduce it to one number.
inline bool some_failed(const AdjointSolution& found, double tolerance) {
  const Tensor errors =
      found.friction.defined() ? at::cat({found.error, found.friction}) : found.error;
  const Tensor here = errors.to(at::kCPU).contiguous();
  const double* const error = here.const_data_ptr<double>();
  return std::any_of(error, error + here.numel(),
                     [&](double e) { return e > adjoint_failed * tolerance; });
}

// The multiplier, and its relative residual for every environment.
template <class Backend>
std::tuple<Tensor, Tensor> solve(const AdjointTensors& t, const AdjointSystem& s,
                                 double time_step) {
  const double tolerance =
      t.after.scalar_type() == at::kFloat ? adjoint_tolerance<float> : adjoint_tolerance<double>;
  const AdjointSolution found =
      iterate<Backend>(t.after, s, t.material, t.plan, tolerance, start_of(t), time_step);
  // a recording cannot read results, and does all of it
  const bool falls_back = Backend::recording(t.after) || some_failed(found, tolerance);
  return {falls_back ? apply_fallback(t, s, time_step, found) : found.solution, found.error};
}

using Wanted =
    std::optional<c10::List<bool>>;  // whether the gradient of each array of the material is wanted

inline void check_wanted(const Wanted& wanted, std::size_t arrays, const char* op) {
  TORCH_CHECK_VALUE(!wanted || wanted->size() == arrays, op, ": wanted must say of each of the ",
                    arrays, " arrays of the material whether its gradient is wanted, got ",
                    wanted ? wanted->size() : 0, " numbers");
}

// The adjoint of a step: gradients for positions, velocities and forces [batch, vertices, 3], then for the `wanted`
// arrays of the material, or all. Gradients that are not wanted cost nothing.
template <class Backend>
std::vector<Tensor> step_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                             const Tensor& after, const Tensor& positions, const Tensor& velocities,
                             const OptionalTensor& forces, at::TensorList given,
                             at::TensorList plan, double time_step, const Wanted& wanted) {
  std::vector<Tensor> material;
  for (const Tensor& array : given) material.push_back(array.contiguous());
  const AdjointTensors t{grad_positions, grad_velocities, after,    positions,
                         velocities,     forces,          material, plan};
  check_wanted(wanted, material.size(), "step_vjp");
  // in the precision of the step, also where autocast asks for less
  const c10::impl::ExcludeDispatchKeyGuard plainly(c10::autocast_dispatch_keyset);
  const auto [right, inertia, inverse, projector, stuck, sliding] =
      adjoint_system<Backend>(grad_positions, grad_velocities, after, positions, velocities, forces,
                              material, plan, time_step);
  const bool touching = projector.size(0) > 0;
  const OptionalTensor free = touching ? OptionalTensor(projector) : OptionalTensor();
  const OptionalTensor slips = touching ? OptionalTensor(sliding) : OptionalTensor();
  const auto [solution, error] =
      solve<Backend>(t, {right, inertia, inverse, free, slips}, time_step);
  Tensor elastic;
  HeldTerms held_terms;
  if (touching) {
    elastic = elastic_product(t, solution, time_step);
    held_terms = {grad_positions, elastic, projector, stuck, sliding};
  }
  auto [x, v, multiplier] = adjoint_result<Backend>(
      solution, error, grad_velocities, material, held_terms.grad_positions, held_terms.elastic,
      held_terms.projector, held_terms.stuck, held_terms.sliding, time_step);
  const LossMask loss_mask(grad_positions, grad_velocities);
  const DampingProducts damping(t, multiplier, time_step);
  if (damping.some()) x = x - damping.by_start();
  std::vector<Tensor> found{loss_mask.masked(x), loss_mask.masked(v), loss_mask.masked(multiplier)};
  const MaterialGradients gradients(
      t, multiplier, elastic, damping,
      [&, l = multiplier](const Tensor& product) {
        const auto wants = [&](const char* name) {
          return !wanted || wanted->get(place_in_material(name));
        };
        return gradients_for_contacts<Backend>(t, l, product, time_step,
                                               {wants("planes"), wants("spheres")});
      },
      &sum_vertices<Backend>, loss_mask, time_step);
  for (std::size_t i = 0; i < material.size(); ++i) {
    if (!wanted || wanted->get(i)) found.push_back(gradients.of(i));
  }
  return found;
}

}  // namespace pd
