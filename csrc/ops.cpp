// The ops: schemas, and the CPU behind them.
#include "ops.h"

#include "cpu/dispatch.h"

#include <ATen/Parallel.h>

#include <string>

namespace pd {
namespace {

struct Cpu {
  template <class T>
  using Plan = pd::Plan<T>;

  template <class T>
  static Plan<T> plan_view(at::TensorList arrays, const Place& place) {
    return pd::plan_view<T>(arrays, place);
  }

  static void step(const StepCall<float>& call, const Tensor&) {
    kernels().step32(call, threads());
  }
  static void step(const StepCall<double>& call, const Tensor&) {
    kernels().step64(call, threads());
  }
  static void field(const FieldCall<float>& call, const Tensor&) {
    kernels().field32(call, threads());
  }
  static void field(const FieldCall<double>& call, const Tensor&) {
    kernels().field64(call, threads());
  }
  static void rotation(const RotationCall<float>& call, const Tensor&) {
    kernels().rotation32(call, threads());
  }
  static void rotation(const RotationCall<double>& call, const Tensor&) {
    kernels().rotation64(call, threads());
  }

  static int threads() { return at::get_num_threads(); }
};

template <class T>
void run_precondition(const Tensor& field, at::TensorList arrays, const Tensor& out) {
  const Plan<T> plan = plan_view<T>(arrays, {field.device(), "field"});
  check_levels(plan, true);
  TORCH_CHECK_VALUE(field.size(1) == plan.vertices, "field must have the ", plan.vertices,
                    " vertices of the plan, got ", describe(field));
  const Tensor from = field.contiguous();
  PreconditionCall<T> call{plan.levels, plan.vertex_order, field.size(0), from.const_data_ptr<T>(),
                           out.mutable_data_ptr<T>()};
  if (call.batch == 0) return;
  if constexpr (sizeof(T) == 4) {
    kernels().precondition32(call, Cpu::threads());
  } else {
    kernels().precondition64(call, Cpu::threads());
  }
}

// No other device has a preconditioner yet.
Tensor precondition(const Tensor& field, at::TensorList plan) {
  check_real(field, "field", "[batch, vertices, 3] (N)");
  TORCH_CHECK_VALUE(field.dim() == 3 && field.size(2) == 3,
                    "field must be [batch, vertices, 3] (N), got ", describe(field));
  const Tensor out = at::empty(field.sizes(), field.options());
  if (field.scalar_type() == at::kFloat) {
    run_precondition<float>(field, plan, out);
  } else {
    run_precondition<double>(field, plan, out);
  }
  return out;
}

const std::string step_numbers =
    "int schedule, int iterations, float time_step, float relaxation, float rho, int delay, bool "
    "weighted, "
    "float tolerance, bool inertial, bool report";

}  // namespace

TORCH_LIBRARY(torchpd, m) {
  m.def(("step(Tensor positions, Tensor velocities, Tensor? forces, Tensor? start, Tensor[] "
         "material, Tensor[] plan, *, " +
         step_numbers + ") -> (Tensor, Tensor, Tensor)")
            .c_str());
  m.def(("step_(Tensor(a!) positions, Tensor(b!) velocities, Tensor(c!) info, Tensor? forces, "
         "Tensor? start, "
         "Tensor[] material, Tensor[] plan, *, " +
         step_numbers + ") -> ()")
            .c_str());
  m.def(("rollout(Tensor positions, Tensor velocities, Tensor? forces, Tensor[] material, Tensor[] "
         "plan, *, int steps, "
         "int every, " +
         step_numbers + ") -> (Tensor, Tensor, Tensor)")
            .c_str());
  m.def("gradient(Tensor positions, Tensor stiffness, Tensor[] plan) -> Tensor");
  m.def(
      "hessian_product(Tensor positions, Tensor direction, Tensor stiffness, Tensor[] plan) -> "
      "Tensor");
  m.def("element_energy(Tensor positions, Tensor stiffness, Tensor[] plan) -> Tensor");
  m.def(
      "element_energy_product(Tensor positions, Tensor direction, Tensor stiffness, Tensor[] plan) "
      "-> Tensor");
  m.def("elastic_diagonal(Tensor stiffness, Tensor[] plan, *, bool weighted) -> Tensor");
  m.def("precondition(Tensor field, Tensor[] plan) -> Tensor");
  m.def("nearest_rotation(Tensor matrices) -> Tensor");
  m.def("rotation_differential(Tensor matrices, Tensor direction) -> Tensor");
}

TORCH_LIBRARY_IMPL(torchpd, CPU, m) {
  register_ops<Cpu>(m);
  m.impl("precondition", &precondition);
}

}  // namespace pd
