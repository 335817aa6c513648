// A solved step, as the ops of its adjoint receive it.
#pragma once
#include "binding/ops.h"
#include "binding/plan_views.h"
#include "solver/adjoint/system.h"

#include <vector>

namespace pd {

// A solved step, and the loss gradients of its outcome.
struct AdjointTensors {
  Tensor grad_positions, grad_velocities, after, positions, velocities;
  OptionalTensor forces;
  at::TensorList material, plan;
  Tensor pushes = {};  // forces between bodies [batch, vertices, 3]; undefined without
};

// The start of a step with damping.
inline OptionalTensor start_of(const AdjointTensors& t) {
  return has_damping(t.material) ? OptionalTensor(t.positions) : OptionalTensor();
}

// A call's view of a solved step, and the tensors that it points into.
template <class Backend, class T>
class SolvedStep {
 public:
  AdjointSystemCall<T, typename Backend::template Plan<T>> call;
  bool touching;

  SolvedStep(const AdjointTensors& t, double time_step) {
    const Place place{t.after.device()};
    call.plan = Backend::template plan_view<T>(t.plan, place);
    call.batch = t.after.size(0);
    check_vertices(t.after, call.plan.vertices);
    call.material = material_view<T>(call.plan, t.material, call.batch, place);
    const Material<T>& m = call.material;
    const Tensor elastic = diagonal_typed<Backend, T>(t.material, t.plan, true, time_step);
    const bool own = elastic.dim() == 2 && elastic.size(0) == call.batch;
    call.elastic = {keep(elastic), own ? call.plan.vertices : 0};
    touching = m.planes_count + m.spheres_count > 0;
    call.time_step = time_step;
    call.grad_positions = keep(t.grad_positions);
    call.grad_velocities = keep(t.grad_velocities);
    if (!touching) return;
    call.after = keep(t.after);
    call.positions = keep(t.positions);
    call.velocities = keep(t.velocities);
    if (t.forces) call.forces = keep(*t.forces);
    const StepOfField step =
        has_damping(t.material) ? StepOfField{time_step, t.positions} : StepOfField{};
    const Tensor gradient =
        run_field<Backend>(Field::gradient, t.after.contiguous(), {}, t.material, t.plan, step);
    call.elastic_gradient = keep(t.pushes.defined() ? gradient - t.pushes : gradient);
  }
  SolvedStep(const SolvedStep&) = delete;

  const T* keep(const Tensor& tensor) {
    kept_.push_back(tensor.contiguous());
    return kept_.back().template const_data_ptr<T>();
  }

 private:
  std::vector<Tensor> kept_;
};

}  // namespace pd
