// The ops: schemas, and their CPU implementation.
#include "binding/rollout_adjoint.h"

#include "binding/contact_adjoint_ops.h"
#include "binding/contact_ops.h"
#include "binding/history_ops.h"
#include "binding/plan_views.h"
#include "binding/rigid_motion_ops.h"
#include "cpu/dispatch.h"

#include <ATen/Parallel.h>

#include <algorithm>
#include <optional>
#include <string>
#include <vector>

namespace pd {
namespace {

struct Cpu {
  static constexpr bool sums_tets = true;  // in Field::effect_energy
  static bool has_stencils(at::TensorList) { return true; }

  template <class T>
  using Plan = pd::Plan<T>;

  template <class T>
  using Step = StepCall<T>;
  template <class T>
  using Field = FieldCall<T>;
  template <class T>
  using Conjugate = ConjugateCall<T>;

  template <class T>
  static Plan<T> plan_view(at::TensorList arrays, const Place& place) {
    return pd::plan_view<T>(arrays, place);
  }
  template <class Call>
  static void view_stencils(Call&, at::TensorList, const Place&) {}  // the plan has them
  template <class Call>
  static const int32* stencil_counts(const Call& call) {
    return pd::stencil_counts(call.plan);
  }

  static void step(const StepCall<float>& call, const Tensor&) {
    kernels().step32(call, threads());
  }
  static void step(const StepCall<double>& call, const Tensor&) {
    kernels().step64(call, threads());
  }
  static void contact_step(const StepCall<float>& call, const ContactCall<float>& contact,
                           const Tensor&) {
    kernels().contact_step32(call, contact, threads());
  }
  static void contact_step(const StepCall<double>& call, const ContactCall<double>& contact,
                           const Tensor&) {
    kernels().contact_step64(call, contact, threads());
  }
  static void field(const FieldCall<float>& call, const Tensor&) {
    kernels().field32(call, threads());
  }
  static void field(const FieldCall<double>& call, const Tensor&) {
    kernels().field64(call, threads());
  }
  static void report(const ReportCall<float>& call, const Tensor&) {
    kernels().report32(call, threads());
  }
  static void report(const ReportCall<double>& call, const Tensor&) {
    kernels().report64(call, threads());
  }
  static void precondition(const PreconditionCall<float>& call, const Tensor&) {
    kernels().precondition32(call, threads());
  }
  static void precondition(const PreconditionCall<double>& call, const Tensor&) {
    kernels().precondition64(call, threads());
  }
  static void conjugate(const ConjugateCall<float>& call, const Tensor&) {
    (call.pairs ? kernels().contact_conjugate32 : kernels().conjugate32)(call, threads());
  }
  static void conjugate(const ConjugateCall<double>& call, const Tensor&) {
    (call.pairs ? kernels().contact_conjugate64 : kernels().conjugate64)(call, threads());
  }
  static void adjoint_system(const AdjointSystemCall<float>& call, const Tensor&) {
    kernels().adjoint_system32(call, threads());
  }
  static void adjoint_system(const AdjointSystemCall<double>& call, const Tensor&) {
    kernels().adjoint_system64(call, threads());
  }
  static void contact_gradients(const ContactGradientsCall<float>& call, const Tensor&) {
    kernels().contact_gradients32(call, threads());
  }
  static void contact_gradients(const ContactGradientsCall<double>& call, const Tensor&) {
    kernels().contact_gradients64(call, threads());
  }
  static void adjoint_result(const AdjointResultCall<float>& call, const Tensor&) {
    kernels().adjoint_result32(call, threads());
  }
  static void adjoint_result(const AdjointResultCall<double>& call, const Tensor&) {
    kernels().adjoint_result64(call, threads());
  }
  template <class T>
  static void vertex_sum(const VertexSumCall<T>& call, const Tensor&) {
    // enough environments a thread to make waking it worth while
    const std::int64_t grain =
        at::internal::GRAIN_SIZE / std::max<std::int64_t>(1, call.vertices * call.numbers) + 1;
    at::parallel_for(0, call.batch, grain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t e = begin; e < end; ++e) {
        for (std::int64_t n = 0; n < call.numbers; ++n) {
          const T* from = call.values + e * call.vertices * call.numbers + n;
          double sum = 0;
          for (std::int64_t i = 0; i < call.vertices; ++i) sum += double(from[i * call.numbers]);
          call.out[e * call.numbers + n] = T(sum);
        }
      }
    });
  }
  static void pair_gradients(const PairGradientsCall<float>& call, const Tensor&) {
    kernels().pair_gradients32(call, threads());
  }
  static void pair_gradients(const PairGradientsCall<double>& call, const Tensor&) {
    kernels().pair_gradients64(call, threads());
  }
  template <class Motion, class T>
  static void find_motion(const RigidMotionCall<T>& call, const Tensor&) {
    each_collider<Motion>(call, [&](std::int64_t row) { pd::find_motion<Motion>(call, row); });
  }
  template <class Motion, class T>
  static void differentiate_motion(const RigidMotionCall<T>& call, const Tensor&) {
    each_collider<Motion>(call, [&](std::int64_t row) {
      for (int n = 0; n < Motion::inputs; ++n) pd::differentiate_motion<Motion>(call, row, n);
    });
  }
  static void rotation(const RotationCall<float>& call, const Tensor&) {
    kernels().rotation32(call, threads());
  }
  static void rotation(const RotationCall<double>& call, const Tensor&) {
    kernels().rotation64(call, threads());
  }

  template <class T>
  static std::optional<LoadedPairs<T>> loaded_pairs(at::TensorList pairs, std::int64_t batch,
                                                    std::int64_t vertices) {
    if (pairs.empty()) return {};
    return loaded_pairs_view<Cpu, T>(pairs, batch, vertices, Place{at::kCPU});
  }
  // each environment has the memory that its own take
  static std::int64_t most_loaded(const Tensor&) { return 0; }
  template <class T>
  static void check_pairs(const LoadedPairs<T>&) {}

  static bool recording(const Tensor&) { return false; }

  static int threads() { return at::get_num_threads(); }

 private:
  template <class Motion, class T, class Visit>
  static void each_collider(const RigidMotionCall<T>& call, const Visit& visit) {
    constexpr std::int64_t grain = 64;  // microseconds each
    at::parallel_for(0, call.batch * call.colliders, grain,
                     [&](std::int64_t begin, std::int64_t end) {
                       for (std::int64_t row = begin; row < end; ++row) visit(row);
                     });
  }
};

}  // namespace

TORCH_LIBRARY(torchpd, m) {
  // A CUDA graph of torch.compile returns tensors that it was given and that others need, such as backward. It cannot
  // return CPU tensors, and every plan has its counts there. So no op that takes a plan may be in such a graph.
  // Graphs of simulation/cuda_graph.py may hold them.
  const std::vector<at::Tag> between_graphs{at::Tag::cudagraph_unsafe};
  const auto with_plan = [&](const std::string& schema) { m.def(schema.c_str(), between_graphs); };
  with_plan(
      "step(Tensor positions, Tensor velocities, Tensor? forces, Tensor? start, Tensor[] material, "
      "Tensor[] plan, *, " +
      settings_schema() + ") -> (Tensor, Tensor, Tensor)");
  with_plan(
      "step_(Tensor(a!) positions, Tensor(b!) velocities, Tensor(c!) info, Tensor? forces, Tensor? "
      "start, Tensor[] material, Tensor[] plan, *, " +
      settings_schema() + ") -> ()");
  with_plan(
      "contact_step(Tensor positions, Tensor velocities, Tensor? forces, Tensor poses, Tensor[] "
      "history, Tensor[] material, Tensor[] plan, Tensor[] contact, *, " +
      settings_schema() +
      ") -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  with_plan(
      "rollout(Tensor positions, Tensor velocities, Tensor? forces, Tensor[] material, Tensor[] "
      "plan, *, SymInt steps, SymInt every, " +
      settings_schema() + ") -> (Tensor, Tensor, Tensor)");
  with_plan("gradient(Tensor positions, Tensor[] material, Tensor[] plan) -> Tensor");
  with_plan(
      "hessian_product(Tensor positions, Tensor direction, Tensor[] material, Tensor[] plan) -> "
      "Tensor");
  with_plan("element_energy(Tensor positions, Tensor[] material, Tensor[] plan) -> Tensor");
  with_plan(
      "element_energy_product(Tensor positions, Tensor direction, Tensor[] material, Tensor[] "
      "plan) "
      "-> Tensor");
  with_plan("effect_energy(Tensor positions, Tensor[] material, Tensor[] plan) -> Tensor");
  with_plan(
      "lame_product(Tensor positions, Tensor? direction, Tensor[] material, Tensor[] plan) -> "
      "Tensor");
  with_plan(
      "effect_products(Tensor positions, Tensor? direction, Tensor[] material, Tensor[] plan) -> "
      "Tensor[]");
  with_plan(
      "damping_gradient(Tensor positions, Tensor start, Tensor[] material, Tensor[] plan, *, float "
      "time_step) -> Tensor");
  with_plan(
      "damping_vjp(Tensor positions, Tensor start, Tensor direction, Tensor[] material, Tensor[] "
      "plan, *, float time_step) -> Tensor[]");
  with_plan(
      "next_history(Tensor positions, Tensor[] material, Tensor[] plan, *, float time_step) -> "
      "Tensor[]");
  with_plan(
      "next_history_vjp(Tensor[] gradients, Tensor positions, Tensor[] material, Tensor[] plan, *, "
      "float time_step) -> Tensor[]");
  // with a time step also that of the energies that a step dissipates
  with_plan(
      "elastic_diagonal(Tensor[] material, Tensor[] plan, *, bool weighted, float time_step=0.0) "
      "-> "
      "Tensor");
  with_plan(
      "stiffness_at_rest(Tensor[] material, Tensor[] plan, *, float time_step=0.0) -> Tensor");
  with_plan("precondition(Tensor field, Tensor[] plan) -> Tensor");
  with_plan(
      "step_vjp(Tensor grad_positions, Tensor grad_velocities, Tensor after, Tensor positions, "
      "Tensor "
      "velocities, Tensor? forces, Tensor[] material, Tensor[] plan, *, float time_step, bool[]? "
      "wanted=None) -> Tensor[]");
  with_plan(
      "rollout_vjp(Tensor grad_positions, Tensor grad_velocities, Tensor after, Tensor "
      "after_velocities, Tensor positions, Tensor velocities, Tensor? forces, Tensor[] material, "
      "Tensor[] plan, *, float time_step, bool[]? wanted=None) -> Tensor[]");
  with_plan(
      "contact_step_vjp(Tensor grad_positions, Tensor grad_velocities, Tensor grad_poses, Tensor "
      "after, Tensor positions, Tensor velocities, Tensor? forces, Tensor poses, Tensor[] history, "
      "Tensor pushes, Tensor taken_back, Tensor[] material, Tensor[] plan, Tensor[] contact, *, "
      "float time_step, bool[]? wanted=None) -> Tensor[]");
  // its kernel, for every device, comes from Python
  with_plan(
      "adjoint_fallback(Tensor solution, Tensor error, Tensor? friction, Tensor after, Tensor "
      "right, Tensor inverse, Tensor? projector, Tensor[] material, Tensor[] plan, Tensor? "
      "start=None, *, float time_step) -> Tensor");
  with_plan(
      "contact_fallback(Tensor solution, Tensor error, Tensor? friction, Tensor after, Tensor "
      "right, Tensor inverse, Tensor? projector, Tensor[] material, Tensor[] plan, Tensor? start, "
      "Tensor[] pairs, *, float time_step) -> Tensor");
  with_plan(
      "adjoint_system(Tensor grad_positions, Tensor grad_velocities, Tensor after, Tensor "
      "positions, Tensor "
      "velocities, Tensor? forces, Tensor[] material, Tensor[] plan, *, float time_step) -> "
      "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  with_plan(
      "contact_gradients(Tensor multiplier, Tensor elastic, Tensor grad_positions, Tensor "
      "grad_velocities, Tensor after, Tensor positions, Tensor velocities, Tensor? forces, "
      "Tensor[] "
      "material, Tensor[] plan, *, float time_step) -> (Tensor, Tensor)");
  m.def(
      "adjoint_result(Tensor multiplier, Tensor error, Tensor grad_velocities, Tensor[] "
      "material, Tensor? grad_positions=None, Tensor? elastic=None, Tensor? projector=None, "
      "Tensor? "
      "stuck=None, Tensor? sliding=None, *, float time_step) -> (Tensor, Tensor, Tensor)");
  with_plan(
      "conjugate_gradients(Tensor positions, Tensor right, Tensor inertia, Tensor inverse, Tensor? "
      "projector, Tensor[] material, Tensor[] plan, Tensor? sliding=None, Tensor? start=None, *, "
      "float "
      "tolerance, float time_step=0.0) -> "
      "(Tensor, Tensor)");
  with_plan(
      "contact_conjugate(Tensor positions, Tensor right, Tensor inertia, Tensor inverse, Tensor? "
      "projector, Tensor[] material, Tensor[] plan, Tensor? sliding, Tensor? start, Tensor[] "
      "pairs, *, float tolerance, float time_step=0.0) -> (Tensor, Tensor)");
  with_plan(
      "conjugate_gradients_(Tensor(a!) solution, Tensor(b!) residual, Tensor(c!) direction, "
      "Tensor(d!) "
      "progress, Tensor positions, Tensor inertia, Tensor inverse, Tensor? projector, Tensor[] "
      "material, Tensor[] plan, Tensor? start=None, *, float tolerance, int iterations, float "
      "time_step=0.0) -> ()");
  m.def(
      "free_motion(Tensor poses, Tensor motion, Tensor? wrenches, Tensor gravity, Tensor bodies, "
      "*, float time_step) -> (Tensor, Tensor, Tensor)");
  m.def(
      "free_motion_vjp(Tensor grad_poses, Tensor grad_rates, Tensor grad_rows, Tensor poses, "
      "Tensor motion, Tensor? wrenches, Tensor gravity, Tensor bodies, *, float time_step) -> "
      "Tensor");
  m.def(
      "motion_after(Tensor before, Tensor goal, Tensor rates, Tensor rows, Tensor poses, Tensor "
      "bodies, *, float time_step) -> Tensor");
  m.def(
      "motion_after_vjp(Tensor grad, Tensor before, Tensor goal, Tensor rates, Tensor rows, Tensor "
      "poses, Tensor bodies, *, float time_step) -> Tensor");
  m.def("nearest_rotation(Tensor matrices) -> Tensor");
  m.def("rotation_differential(Tensor matrices, Tensor direction) -> Tensor");
}

TORCH_LIBRARY_IMPL(torchpd, CPU, m) {
  register_ops<Cpu>(m);
  register_adjoint_ops<Cpu>(m);
  register_history_ops<Cpu>(m);
  register_contact_ops<Cpu>(m);
  register_contact_adjoint<Cpu>(m);
  register_rigid_motion<Cpu>(m);
}

}  // namespace pd
