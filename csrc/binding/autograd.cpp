// The autograd functions of a step and a rollout. Their adjoints are ops of their own, step_vjp and rollout_vjp.
//
// They are not registered from Python, where the lists of a plan and of a material cost more than a small step
// itself.
#include "binding/find_op.h"
#include "binding/plan_views.h"
#include "binding/settings.h"

#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <tuple>
#include <utility>

namespace pd {
namespace {

using OptionalTensor = std::optional<Tensor>;
using Outputs = std::tuple<Tensor, Tensor, Tensor>;
using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

Outputs plain_step(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                   const OptionalTensor& forces, const OptionalTensor& start,
                   at::TensorList material, at::TensorList plan) {
  using Step = WithSettings<decltype(plain_step)>;
  static const auto op = find_op<Step::Op>("torchpd::step");
  const at::AutoDispatchBelowADInplaceOrView below;
  return Step::call(op, n, positions, velocities, forces, start, material, plan);
}

Outputs plain_rollout(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                      const OptionalTensor& forces, at::TensorList material, at::TensorList plan,
                      c10::SymInt steps, c10::SymInt every) {
  using Rollout = WithSettings<decltype(plain_rollout)>;
  static const auto op = find_op<Rollout::Op>("torchpd::rollout");
  const at::AutoDispatchBelowADInplaceOrView below;
  return Rollout::call(op, n, positions, velocities, forces, material, plan, std::move(steps),
                       std::move(every));
}

// The arrays of a material that autograd asks for.
using Wanted = std::optional<c10::List<bool>>;

// A solved step, for its adjoint; or a rollout, with `after` and `after_velocities` of all its steps.
struct SavedStep {
  Tensor positions, velocities;
  OptionalTensor forces;
  Tensor after, after_velocities;
};

// Gradients for positions, velocities and forces, then for the wanted arrays of the material.
variable_list call_step_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                            const SavedStep& step, at::TensorList material, at::TensorList plan,
                            double time_step, const Wanted& wanted) {
  static const auto op =
      find_op<variable_list(const Tensor&, const Tensor&, const Tensor&, const Tensor&,
                            const Tensor&, const OptionalTensor&, at::TensorList, at::TensorList,
                            double, const Wanted&)>("torchpd::step_vjp");
  return op.call(grad_positions.contiguous(), grad_velocities.contiguous(), step.after,
                 step.positions, step.velocities, step.forces, material, plan, time_step, wanted);
}

// The same for a rollout, from gradients for all that it recorded.
variable_list call_rollout_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                               const SavedStep& steps, at::TensorList material, at::TensorList plan,
                               double time_step, const Wanted& wanted) {
  static const auto op =
      find_op<variable_list(const Tensor&, const Tensor&, const Tensor&, const Tensor&,
                            const Tensor&, const Tensor&, const OptionalTensor&, at::TensorList,
                            at::TensorList, double, const Wanted&)>("torchpd::rollout_vjp");
  return op.call(grad_positions, grad_velocities, steps.after, steps.after_velocities,
                 steps.positions, steps.velocities, steps.forces, material, plan, time_step,
                 wanted);
}

// Arguments without derivatives, which both functions need. `info` is returned past autograd: it is a report.
struct Unvaried {
  at::TensorList plan;
  Numbers numbers;
  c10::SymInt steps = 1, every = 1;
  Tensor* info = nullptr;
};

// Keeps the inputs that have derivatives, the positions that came out, the velocities `between` steps, and the plan;
// missing ones are undefined.
variable_list keep(AutogradContext* context, const Tensor& positions, const Tensor& velocities,
                   const OptionalTensor& forces, const Outputs& outputs, const Tensor& between,
                   at::TensorList material, const Unvaried& rest) {
  const auto& [after, after_velocities, info] = outputs;
  variable_list saved{positions, velocities, forces.value_or(Tensor()), after, between};
  saved.insert(saved.end(), material.begin(), material.end());
  saved.insert(saved.end(), rest.plan.begin(), rest.plan.end());
  context->save_for_backward(std::move(saved));
  context->saved_data["time_step"] = rest.numbers.time_step;
  context->saved_data["thins"] = rest.every != 1;
  context->saved_data["arrays"] = std::int64_t(material.size());
  *rest.info = info;
  return {after, after_velocities};
}

struct SavedTensors {
  Tensor positions, velocities;
  OptionalTensor forces;
  Tensor after, after_velocities;
  variable_list material, plan;

  // `arrays`: those of the material
  SavedTensors(const variable_list& saved, std::int64_t arrays)
      : positions(saved[0]),
        velocities(saved[1]),
        after(saved[3]),
        after_velocities(saved[4]),
        material(saved.begin() + 5, saved.begin() + 5 + arrays),
        plan(saved.begin() + 5 + arrays, saved.end()) {
    if (saved[2].defined()) forces = saved[2];
  }
};

// Inputs that autograd may ask for, in the order of a function's arguments: state, other inputs, material.
struct Edges {
  const AutogradContext* context;
  std::size_t first_of_material;

  c10::List<bool> material(std::size_t count) const {
    c10::List<bool> wanted;
    for (std::size_t i = 0; i < count; ++i)
      wanted.push_back(context->needs_input_grad(first_of_material + i));
    return wanted;
  }
};

// The wanted gradients at the places of all arrays.
void append_in_places(variable_list& to, const c10::List<bool>& wanted, const Tensor* values) {
  for (const bool one : wanted) to.push_back(one ? *values++ : Tensor());
}

class StepFunction : public torch::autograd::Function<StepFunction> {
 public:
  static variable_list forward(AutogradContext* context, const Tensor& positions,
                               const Tensor& velocities, const OptionalTensor& forces,
                               const OptionalTensor& start, at::TensorList material,
                               const Unvaried& rest) {
    const Outputs outputs =
        plain_step(rest.numbers, positions, velocities, forces, start, material, rest.plan);
    context->saved_data["starts"] = start.has_value();
    return keep(context, positions, velocities, forces, outputs, Tensor(), material, rest);
  }

  static variable_list backward(AutogradContext* context, const variable_list& grads) {
    const SavedTensors kept(context->get_saved_variables(), context->saved_data["arrays"].toInt());
    const bool forces = kept.forces.has_value(), starts = context->saved_data["starts"].toBool();
    const std::size_t start_edge = forces ? 3 : 2;
    TORCH_CHECK(!starts || !context->needs_input_grad(start_edge),
                "torchpd: a step has no derivative for its first iterate; detach start");
    const c10::List<bool> wanted =
        Edges{context, start_edge + (starts ? 1 : 0)}.material(kept.material.size());
    const variable_list values = call_step_vjp(
        grads[0], grads[1], {kept.positions, kept.velocities, kept.forces, kept.after, {}},
        kept.material, kept.plan, context->saved_data["time_step"].toDouble(), wanted);
    variable_list result{values[0], values[1], forces ? values[2] : Tensor(), Tensor()};
    append_in_places(result, wanted, values.data() + 3);
    result.push_back(Tensor());
    return result;
  }
};

// A gradient of all steps; one that the loss does not depend on takes no memory.
Tensor known(const Tensor& gradient, const Tensor& like) {
  return gradient.defined() ? gradient
                            : at::zeros({1}, like.options()).expand_symint(like.sym_sizes());
}

class RolloutFunction : public torch::autograd::Function<RolloutFunction> {
 public:
  static variable_list forward(AutogradContext* context, const Tensor& positions,
                               const Tensor& velocities, const OptionalTensor& forces,
                               at::TensorList material, const Unvaried& rest) {
    const Outputs outputs = plain_rollout(rest.numbers, positions, velocities, forces, material,
                                          rest.plan, rest.steps, rest.every);
    context->set_materialize_grads(false);
    return keep(context, positions, velocities, forces, outputs, std::get<1>(outputs), material,
                rest);
  }

  static variable_list backward(AutogradContext* context, const variable_list& grads) {
    TORCH_CHECK(!context->saved_data["thins"].toBool(),
                "torchpd: the rollout op is differentiable with every=1 only, where it records "
                "every state");
    const SavedTensors kept(context->get_saved_variables(), context->saved_data["arrays"].toInt());
    const bool forces = kept.forces.has_value();
    const c10::List<bool> wanted = Edges{context, forces ? 3u : 2u}.material(kept.material.size());
    const variable_list values = call_rollout_vjp(
        known(grads[0], kept.after), known(grads[1], kept.after),
        {kept.positions, kept.velocities, kept.forces, kept.after, kept.after_velocities},
        kept.material, kept.plan, context->saved_data["time_step"].toDouble(), wanted);
    variable_list result{values[0], values[1], forces ? values[2] : Tensor()};
    append_in_places(result, wanted, values.data() + 3);
    result.push_back(Tensor());
    return result;
  }
};

bool varies(at::TensorList tensors) {
  for (const Tensor& t : tensors) {
    if (t.requires_grad()) return true;
  }
  return false;
}

// Inside torch.func.grad and similar transforms torch accepts only functions from Python.
void refuse_transforms() {
  const auto& transforms = at::functorch::functorchTLSAccessor();
  if (!transforms) return;
  try {
    transforms->checkSupportsCppAutogradFunction();
  } catch (const c10::Error&) {
    TORCH_CHECK(false,
                "torchpd: a step has no derivative within torch.func.grad, vjp or jacrev; use "
                "torch.autograd.grad, whose is_grads_batched takes many gradients at once");
  }
}

bool varies(const Tensor& positions, const Tensor& velocities, const OptionalTensor& forces,
            const OptionalTensor& start, at::TensorList material) {
  return at::GradMode::is_enabled() && (positions.requires_grad() || velocities.requires_grad() ||
                                        (forces && forces->requires_grad()) ||
                                        (start && start->requires_grad()) || varies(material));
}

Outputs step(const Numbers& n, const Tensor& positions, const Tensor& velocities,
             const OptionalTensor& forces, const OptionalTensor& start, at::TensorList material,
             at::TensorList plan) {
  if (!varies(positions, velocities, forces, start, material))
    return plain_step(n, positions, velocities, forces, start, material, plan);
  refuse_transforms();
  Tensor info;
  const variable_list state = StepFunction::apply(positions, velocities, forces, start, material,
                                                  Unvaried{plan, n, 1, 1, &info});
  return {state[0], state[1], info};
}

Outputs rollout(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                const OptionalTensor& forces, at::TensorList material, at::TensorList plan,
                c10::SymInt steps, c10::SymInt every) {
  if (!varies(positions, velocities, forces, {}, material))
    return plain_rollout(n, positions, velocities, forces, material, plan, std::move(steps),
                         std::move(every));
  refuse_transforms();
  Tensor info;
  const variable_list track =
      RolloutFunction::apply(positions, velocities, forces, material,
                             Unvaried{plan, n, std::move(steps), std::move(every), &info});
  return {track[0], track[1], info};
}

// Marks an op that has first derivatives only.
class LastDerivative : public torch::autograd::Function<LastDerivative> {
 public:
  static variable_list forward(AutogradContext*, at::TensorList,
                               const std::function<variable_list()>& run) {
    return run();
  }
  static variable_list backward(AutogradContext*, const variable_list&) {
    TORCH_CHECK(false,
                "torchpd: a step has first derivatives only; differentiate without create_graph, "
                "or take differences of the gradients of two steps");
  }
};

variable_list differentiable_once(variable_list inputs, const OptionalTensor& forces,
                                  at::TensorList material,
                                  const std::function<variable_list()>& run) {
  if (forces) inputs.push_back(*forces);
  inputs.insert(inputs.end(), material.begin(), material.end());
  if (!at::GradMode::is_enabled() || !varies(inputs)) return run();
  return LastDerivative::apply(at::TensorList(inputs), run);
}

variable_list step_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                       const Tensor& after, const Tensor& positions, const Tensor& velocities,
                       const OptionalTensor& forces, at::TensorList material, at::TensorList plan,
                       double time_step, const Wanted& wanted) {
  const auto run = [&] {
    const at::AutoDispatchBelowADInplaceOrView below;
    return call_step_vjp(grad_positions, grad_velocities,
                         {positions, velocities, forces, after, {}}, material, plan, time_step,
                         wanted);
  };
  return differentiable_once({grad_positions, grad_velocities, after, positions, velocities},
                             forces, material, run);
}

variable_list rollout_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                          const Tensor& after, const Tensor& after_velocities,
                          const Tensor& positions, const Tensor& velocities,
                          const OptionalTensor& forces, at::TensorList material,
                          at::TensorList plan, double time_step, const Wanted& wanted) {
  const auto run = [&] {
    const at::AutoDispatchBelowADInplaceOrView below;
    return call_rollout_vjp(grad_positions, grad_velocities,
                            {positions, velocities, forces, after, after_velocities}, material,
                            plan, time_step, wanted);
  };
  return differentiable_once(
      {grad_positions, grad_velocities, after, after_velocities, positions, velocities}, forces,
      material, run);
}

}  // namespace

TORCH_LIBRARY_IMPL(torchpd, Autograd, m) {
  m.impl("step", unpacked<&step>);
  m.impl("rollout", unpacked<&rollout>);
  m.impl("step_vjp", &step_vjp);
  m.impl("rollout_vjp", &rollout_vjp);
}

}  // namespace pd
