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
  static void precondition(const PreconditionCall<float>& call, const Tensor&) {
    kernels().precondition32(call, threads());
  }
  static void precondition(const PreconditionCall<double>& call, const Tensor&) {
    kernels().precondition64(call, threads());
  }
  static void rotation(const RotationCall<float>& call, const Tensor&) {
    kernels().rotation32(call, threads());
  }
  static void rotation(const RotationCall<double>& call, const Tensor&) {
    kernels().rotation64(call, threads());
  }

  static int threads() { return at::get_num_threads(); }
};

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

TORCH_LIBRARY_IMPL(torchpd, CPU, m) { register_ops<Cpu>(m); }

}  // namespace pd
