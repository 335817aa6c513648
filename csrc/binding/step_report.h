// The report of solved steps, on either device. Its own passes over elements and vertices serve any kernel. Included
// by binding/ops.h.
#pragma once
#include "binding/ops.h"

namespace pd {

// `contact`: forces of contact on every vertex, those of bodies first [batch, rows, 3], or null.
template <class Backend, class T>
void report_typed(const StepTensors& t, const Numbers& n, const Tensor* contact) {
  ReportCall<T, typename Backend::template Plan<T>> call;
  const Place place{t.positions.device()};
  call.plan = Backend::template plan_view<T>(t.plan, place);
  call.batch = t.positions.size(0);
  if (call.batch == 0) return;
  call.material = material_view<T>(call.plan, t.material, call.batch, place);
  call.time_step = n.time_step;
  const Tensor x = t.positions.contiguous(), v = t.velocities.contiguous();
  const Tensor f = t.forces ? t.forces->contiguous() : Tensor();
  // u; positions alone have lost digits of it
  const Tensor u = t.out_velocities.mul(n.time_step);
  const auto field = [&](Field kind) {
    const Tensor out = at::empty_like(x);
    field_typed<Backend, T>(kind, x, {}, t.material, t.plan, out, u, {}, {n.time_step});
    return out;
  };
  const Tensor gradient = field(Field::gradient), elements = field(Field::report);
  const Tensor elastic = diagonal_typed<Backend, T>(t.material, t.plan, n.weighted, n.time_step);
  const Tensor sums = at::empty({call.batch, call.chunks(), report_sums}, t.info.options());
  call.elastic = {elastic.const_data_ptr<T>(),
                  elastic.dim() == 2 && elastic.size(0) == call.batch ? call.plan.vertices : 0};
  call.positions = x.const_data_ptr<T>();
  call.velocities = v.const_data_ptr<T>();
  call.forces = f.defined() ? f.const_data_ptr<T>() : nullptr;
  if (contact) {
    call.contact = contact->const_data_ptr<T>();
    call.contact_rows = contact->size(1);
  }
  call.displacement = u.const_data_ptr<T>();
  call.elastic_gradient = gradient.const_data_ptr<T>();
  call.elements = elements.const_data_ptr<T>();
  call.sums = sums.mutable_data_ptr<double>();
  call.info = t.info.mutable_data_ptr<double>();
  Backend::report(call, t.positions);
}

template <class Backend>
void report_step(const StepTensors& taken, const Numbers& n, const Tensor* contact) {
  if (taken.positions.scalar_type() == at::kFloat) {
    report_typed<Backend, float>(taken, n, contact);
  } else {
    report_typed<Backend, double>(taken, n, contact);
  }
}

// The last step of a record alone, since a report needs the state before it. Spheres move on by as many additions as
// in a call.
template <class Backend>
void report_rollout(const StepTensors& t, const Numbers& n, const Settings& settings) {
  std::vector<Tensor> material(t.material.begin(), t.material.end());
  Tensor& spheres = material[place_in_material("spheres")];
  const bool moves = spheres.dim() > 0 && spheres.numel() > 0;
  const auto take = [&](const StepTensors& tensors, int steps) {
    Settings some = settings;
    some.steps = some.every = steps;
    run_step<Backend>(tensors, some);
    for (int s = 0; moves && s < steps; ++s) {
      const Tensor center =
          spheres.narrow(-1, spheres_center, 3) + spheres.narrow(-1, spheres_motion, 3);
      spheres = at::cat({center, spheres.narrow(-1, 3, spheres_numbers - 3)}, -1);
    }
  };
  Tensor x = t.positions, v = t.velocities;
  const std::int64_t records = settings.steps / settings.every;
  for (std::int64_t record = 0; record < records; ++record) {
    const Tensor info = t.info[record];
    if (settings.every > 1) {
      const Tensor ahead = at::empty_like(t.out_positions[record]), speed = at::empty_like(ahead);
      take({x, v, t.forces, {}, material, t.plan, ahead, speed, info}, settings.every - 1);
      x = ahead;
      v = speed;
    }
    const std::vector<Tensor> now = material;
    const StepTensors last{
        x, v, t.forces, {}, now, t.plan, t.out_positions[record], t.out_velocities[record], info};
    take(last, 1);
    report_step<Backend>(last, n);
    x = last.out_positions;
    v = last.out_velocities;
  }
}

}  // namespace pd
