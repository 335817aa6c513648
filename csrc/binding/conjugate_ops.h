// The solve of a step's adjoint on either device. A Backend runs a call by `conjugate`.
#pragma once
#include "binding/checks.h"
#include "binding/material_views.h"
#include "binding/plan_views.h"
#include "binding/settings.h"

#include <cstdint>
#include <limits>
#include <optional>

namespace pd {

using OptionalTensor = std::optional<Tensor>;

struct ConjugateTensors {
  Tensor solution, residual, direction, progress, positions, inertia, inverse;
  OptionalTensor projector;
  at::TensorList material, plan;
  OptionalTensor sliding, right, friction;  // all or none
  OptionalTensor start = {};                // of the step whose dissipation counts
  double time_step = 0;
  at::TensorList pairs = {};  // between bodies, see Backend::loaded_pairs; none: no pairs
};

template <class Backend, class T>
void conjugate_typed(const ConjugateTensors& t, double tolerance, std::int64_t iterations) {
  typename Backend::template Conjugate<T> call;
  const Place place{t.positions.device()};
  call.plan = Backend::template plan_view<T>(t.plan, place);
  Backend::view_stencils(call, t.plan, place);
  call.batch = t.positions.size(0);
  check_vertices(t.positions, call.plan.vertices);
  const Tensor x = t.positions.contiguous();
  const Tensor start = t.start ? t.start->contiguous() : Tensor();
  if (start.defined()) {
    call.start = start.const_data_ptr<T>();
    call.per_time = T(1 / t.time_step);
  }
  const Tensor w = stiffness_of(t.material, call.plan.tets);
  const Tensor a = t.inertia.contiguous(), inverse = t.inverse.contiguous();
  const Tensor p = t.projector ? t.projector->contiguous() : Tensor();
  const Tensor slides = t.sliding ? t.sliding->contiguous() : Tensor();
  const auto of_vertices = [&](const Tensor& values, const char* name, const char* meaning) {
    TORCH_CHECK_TYPE(values.scalar_type() == t.positions.scalar_type(), name, " must be ",
                     at::toString(t.positions.scalar_type()), " like positions (", meaning,
                     "), got ", describe(values));
    const bool own = values.dim() == 2 && (values.size(0) == 1 || values.size(0) == call.batch);
    TORCH_CHECK_VALUE((own || values.dim() == 1) && values.size(-1) == call.plan.vertices &&
                          values.device() == place.device,
                      name, " must be [vertices] or [batch, vertices] beside positions (", meaning,
                      "), got ", describe(values));
    return values_view<T>(values, call.plan.vertices, 1, false, call.batch, place, name, meaning);
  };
  call.stiffness = values_view<T>(w, call.plan.tets, 1, false, call.batch, place, "stiffness",
                                  "Young's modulus [Pa]");
  const EffectArrays<T> effects(Backend::stencil_counts(call), call.plan.tets, t.material,
                                call.batch, place);
  call.effects = effects.view;
  call.effects.stiffness = call.stiffness;
  call.inertia = of_vertices(a, "inertia", "N/m");
  call.inverse = of_vertices(inverse, "inverse", "of the diagonal [m/N], 0 for what is held");
  call.positions = x.const_data_ptr<T>();
  call.projector = p.defined() ? p.const_data_ptr<T>() : nullptr;
  if (slides.defined()) {
    call.sliding = slides.const_data_ptr<T>();
    call.right = t.right->const_data_ptr<T>();
    call.friction = t.friction->mutable_data_ptr<double>();
  }
  call.solution = t.solution.mutable_data_ptr<T>();
  call.residual = t.residual.mutable_data_ptr<T>();
  call.direction = t.direction.mutable_data_ptr<T>();
  call.progress = t.progress.mutable_data_ptr<double>();
  call.tolerance = tolerance;
  call.iterations = int(iterations);
  const auto pairs = Backend::template loaded_pairs<T>(t.pairs, call.batch, call.plan.vertices);
  if (pairs) {
    call.pairs = &*pairs;
    call.right = t.right->const_data_ptr<T>();
    call.friction = t.friction->mutable_data_ptr<double>();
  }
  if (call.batch > 0 && iterations > 0) Backend::conjugate(call, t.positions);
}

template <class Backend>
void solve_conjugate(const ConjugateTensors& t, double tolerance, std::int64_t iterations) {
  if (t.projector) check_projector(*t.projector, t.positions);
  if (t.sliding) check_sliding(*t.sliding, t.positions);
  TORCH_CHECK_VALUE(tolerance >= 0, "tolerance must be >= 0, got ", tolerance);
  if (t.start) {
    check_state(*t.start, t.positions, "start", "positions at the start of the step, m");
    CheckSetting::time_step(t.time_step);
  }
  if (t.positions.scalar_type() == at::kFloat) {
    conjugate_typed<Backend, float>(t, tolerance, iterations);
  } else {
    conjugate_typed<Backend, double>(t, tolerance, iterations);
  }
}

template <class Backend>
void conjugate_gradients_inplace(const Tensor& solution, const Tensor& residual,
                                 const Tensor& direction, const Tensor& progress,
                                 const Tensor& positions, const Tensor& inertia,
                                 const Tensor& inverse, const OptionalTensor& projector,
                                 at::TensorList material, at::TensorList plan,
                                 const OptionalTensor& start, double tolerance,
                                 std::int64_t iterations, double time_step) {
  check_positions(positions, "positions");
  const Place place{positions.device()};
  const auto check_vectors = [&](const Tensor& t, const char* name, const char* meaning) {
    check_state(t, positions, name, meaning);
    check_storage(t, positions.scalar_type(), place, name, meaning);
  };
  check_vectors(solution, "solution", "m");
  check_vectors(residual, "residual", "N");
  check_vectors(direction, "direction", "m");
  check_array(progress, at::kDouble, positions.size(0), progress_count, place, "progress",
              "r . z, |right side|, 1 while it goes on or -1 at the start, relative residual",
              "make it for this batch");
  TORCH_CHECK_VALUE(iterations >= 0 && iterations <= std::numeric_limits<int>::max(),
                    "iterations must be in [0, 2^31), got ", iterations);
  const OptionalTensor none;
  solve_conjugate<Backend>({solution, residual, direction, progress, positions, inertia, inverse,
                            projector, material, plan, none, none, none, start, time_step},
                           tolerance, iterations);
  for (const Tensor& t : {solution, residual, direction, progress}) {
    if (!t.is_inference()) t.unsafeGetTensorImpl()->bump_version();
  }
}

}  // namespace pd
