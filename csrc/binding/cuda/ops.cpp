// The ops on CUDA. Torch provides memory, stream and device.
#include "binding/rollout_adjoint.h"

#include "binding/contact_adjoint_ops.h"
#include "binding/contact_ops.h"
#include "binding/plan_views.h"
#include "binding/rigid_motion_ops.h"
#include "cuda/common/launch.h"
#include "cuda/contact/rigid_motion.h"
#include "cuda/poisson/launch.h"

#include <c10/cuda/CUDAGraphsC10Utils.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

namespace pd {
namespace {

struct Cuda {
  static constexpr bool sums_tets = false;  // in Field::effect_energy
  static bool has_stencils(at::TensorList plan) { return has_device_stencils(plan); }

  template <class T>
  using Plan = DevicePlan<T>;

  template <class T>
  static Plan<T> plan_view(at::TensorList arrays, const Place& place) {
    return device_plan_view<T>(arrays, place);
  }

  template <class T>
  using Step = Mixed<DeviceStep<T>>;
  template <class T>
  using Field = Mixed<DeviceField<T>>;
  template <class T>
  using Conjugate = Mixed<DeviceConjugate<T>>;

  template <class T>
  static std::optional<LoadedPairs<T>> loaded_pairs(at::TensorList pairs, std::int64_t batch,
                                                    std::int64_t vertices) {
    if (pairs.empty()) return {};
    return loaded_pairs_view<Cuda, T>(pairs, batch, vertices, Place{pairs[0].device()});
  }
  // Waits for the GPU, so that memory is for the pairs that there are. A recording cannot read them.
  static std::int64_t most_loaded(const Tensor& forces) {
    if (recording(forces)) return forces.size(1);
    return forces.numel() == 0 ? 0
                               : forces.select(-1, 0).gt(0).sum(1).max().item().to<std::int64_t>();
  }
  template <class T>
  static void check_pairs(const LoadedPairs<T>& pairs) {
    const std::int64_t bytes = bytes_of_pairs(pairs);
    TORCH_CHECK_NOT_IMPLEMENTED(bytes <= most_pair_bytes, "gradients of a step with Contact take ",
                                bytes, " bytes on a GPU for an environment of ", pairs.most,
                                " pairs with forces; at most ", most_pair_bytes,
                                " are taken. Coarsen the surfaces, or differentiate on the CPU");
  }

  template <class Call>
  static void view_stencils(Mixed<Call>& call, at::TensorList arrays, const Place& place) {
    call.stencils = device_stencils_view<typename Call::real>(arrays, call.plan.patches, place);
  }
  template <class Call>
  static const int32* stencil_counts(const Mixed<Call>& call) {
    return call.stencils.blocks > 0 ? call.stencils.stencil_sizes + stencil_size_count : nullptr;
  }

  // With Poisson's ratio, which the kernels of cuda/poisson read beside the tetrahedra.
  template <class Call>
  static Mixed<Call> with_poisson(const Mixed<Call>& call) {
    Mixed<Call> own = call;
    own.poisson = call.effects.poisson;
    return own;
  }
  template <class Call>
  static bool runs_with_poisson(const Mixed<Call>& call) {
    TORCH_CHECK_VALUE(!call.effects.poisson.data || call.plan.members > 0,
                      "plan must have groups of tetrahedra for a material with Poisson's ratio; "
                      "compile the scene again");
    return call.plan.members > 0;
  }
  template <class Call>
  static bool is_mixed(const Mixed<Call>& call) {
    return call.stencils.blocks > 0;
  }

  // The rows of a plan have no place for an array that the scene lacks.
  template <class T>
  static void check_rows([[maybe_unused]] const Step<T>& call) {
#define KIND(name, type, what)
#define PARAMETER(kind, array)                                                            \
  TORCH_CHECK_VALUE(!(call.stencils.rows[row_kinds] >> int(KindNumber::kind) & 1) ||      \
                        !ArraysOf<TypeOf<KindNumber::kind>>().may_lack(effect_##array) || \
                        !call.effects.array.data,                                         \
                    "material." #array                                                    \
                    " must be empty for the plan of a scene without it; "                 \
                    "compile a scene that has it");
#include "elements/kinds.def"
#undef KIND
  }

  template <class T>
  static void step(const Step<T>& call, const Tensor& like) {
    TORCH_CHECK_VALUE(!call.settings.newton(),
                      "schedule must be 0 (jacobi) to 4 (momentum) on a GPU, got 5 (newton), which "
                      "has no kernels; call the op on the CPU, or take 3 (lbfgs)");
    check_rows<T>(call);
    const bool stream = call.plan.kernel == int(DeviceKernel::stream);
    if (runs_with_poisson(call)) {
      const Step<T> own = with_poisson(call);
      is_mixed(own) ? run(like, own, poisson::mixed_step_bytes<T>,
                          stream ? poisson::run_mixed_stream<T> : poisson::run_mixed_block<T>)
                    : run<DeviceStep<T>>(like, own, poisson::step_bytes<T>,
                                         stream ? poisson::run_stream<T> : poisson::run_fused<T>);
    } else {
      is_mixed(call)
          ? run(like, call, mixed_step_bytes<T>, stream ? run_mixed_stream<T> : run_mixed_block<T>)
          : run<DeviceStep<T>>(like, call, step_bytes<T>, stream ? run_stream<T> : run_fused<T>);
    }
  }

  template <class T>
  static void contact_step(const Step<T>& call, const ContactCall<T>& contact, const Tensor& like) {
    TORCH_CHECK_VALUE(call.plan.kernel == int(DeviceKernel::stream),
                      "plan must be one for kernel 3 (stream) in a scene with Contact, got kernel ",
                      call.plan.kernel, "; compile the scene again");
    check_rows<T>(call);
    using Solids = WithContact<DeviceStep<T>>;
    using All = WithContact<Step<T>>;
    if (runs_with_poisson(call)) {
      const Step<T> own = with_poisson(call);
      is_mixed(own) ? run<All>(like, {own, contact}, poisson::contact_mixed_bytes<T>,
                               poisson::run_contact_mixed<T>)
                    : run<Solids>(like, {own, contact}, poisson::contact_stream_bytes<T>,
                                  poisson::run_contact_stream<T>);
    } else {
      is_mixed(call)
          ? run<All>(like, {call, contact}, contact_mixed_bytes<T>, run_contact_mixed<T>)
          : run<Solids>(like, {call, contact}, contact_stream_bytes<T>, run_contact_stream<T>);
    }
  }

  template <class T>
  static void field(const Field<T>& call, const Tensor& like) {
    // what belongs to effects is zero
    const bool of_effects = call.field == pd::Field::effect_energy ||
                            call.field == pd::Field::effect_products || is_of_damping(call.field);
    if (of_effects && !is_mixed(call)) return void(like.zero_());
    if (is_of_damping(call.field) && !runs_with_poisson(call)) return void(like.zero_());
    if (runs_with_poisson(call)) {
      const Field<T> own = with_poisson(call);
      is_mixed(own)
          ? run(like, own, poisson::mixed_field_bytes<T>, poisson::run_mixed_field<T>)
          : run<DeviceField<T>>(like, own, poisson::field_bytes<T>, poisson::run_field<T>);
    } else {
      is_mixed(call) ? run(like, call, mixed_field_bytes<T>, run_mixed_field<T>)
                     : run<DeviceField<T>>(like, call, field_bytes<T>, run_field<T>);
    }
  }

  template <class T>
  static void report(const DeviceReport<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_report(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  template <class T>
  static void precondition(const PreconditionCall<T>& call, const Tensor& like) {
    run(like, call, precondition_bytes<T>, run_precondition<T>);
  }

  template <class T>
  static void conjugate(const Conjugate<T>& call, const Tensor& like) {
    if (call.pairs) return contact_conjugate(call, like);
    if (runs_with_poisson(call)) {
      const Conjugate<T> own = with_poisson(call);
      is_mixed(own)
          ? run(like, own, poisson::mixed_conjugate_bytes<T>, poisson::run_mixed_conjugate<T>)
          : run<DeviceConjugate<T>>(like, own, poisson::conjugate_bytes<T>,
                                    poisson::run_conjugate<T>);
    } else {
      is_mixed(call) ? run(like, call, mixed_conjugate_bytes<T>, run_mixed_conjugate<T>)
                     : run<DeviceConjugate<T>>(like, call, conjugate_bytes<T>, run_conjugate<T>);
    }
  }

  template <class T>
  static void contact_conjugate(const Conjugate<T>& call, const Tensor& like) {
    TORCH_CHECK_VALUE(call.plan.kernel == int(DeviceKernel::stream),
                      "plan must be one for kernel 3 (stream) in a scene with Contact, got kernel ",
                      call.plan.kernel, "; compile the scene again");
    if (runs_with_poisson(call)) {
      run(like, with_poisson(call), poisson::contact_conjugate_bytes<T>,
          poisson::run_contact_conjugate<T>);
    } else {
      run(like, call, contact_conjugate_bytes<T>, run_contact_conjugate<T>);
    }
  }

  template <class T>
  static void pair_gradients(const PairGradientsCall<T>& call, const Tensor& like) {
    run(like, call, pair_gradients_bytes<T>, run_pair_gradients<T>);
  }

  template <class T>
  static void adjoint_system(const DeviceAdjointSystem<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_adjoint_system(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  template <class T>
  static void contact_gradients(const DeviceContactGradients<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_contact_gradients(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  template <class T>
  static void adjoint_result(const AdjointResultCall<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_adjoint_result(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  template <class T>
  static void vertex_sum(const VertexSumCall<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_vertex_sum(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  template <class Motion, class T>
  static void find_motion(const RigidMotionCall<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_find_motion<Motion>(call, c10::cuda::getCurrentCUDAStream().stream());
  }
  template <class Motion, class T>
  static void differentiate_motion(const RigidMotionCall<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_differentiate_motion<Motion>(call, c10::cuda::getCurrentCUDAStream().stream());
  }

  static bool recording(const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    return c10::cuda::currentStreamCaptureStatusMayInitCtx() != c10::cuda::CaptureStatus::None;
  }

  template <class T>
  static void rotation(const RotationCall<T>& call, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_rotation(call, c10::cuda::getCurrentCUDAStream().stream());
  }

 private:
  // The memory returns to torch's allocator at once, which reuses it only on the same stream.
  template <class Call>
  static void run(const Tensor& like, const Call& call, std::int64_t (*bytes)(const Call&),
                  void (*launch)(const Call&, void*, Stream)) {
    const c10::cuda::CUDAGuard guard(like.device());
    const Tensor memory = at::empty({bytes(call)}, like.options().dtype(at::kByte));
    launch(call, memory.mutable_data_ptr(), c10::cuda::getCurrentCUDAStream().stream());
  }
};

}  // namespace

TORCH_LIBRARY_IMPL(torchpd, CUDA, m) {
  register_ops<Cuda>(m);
  register_adjoint_ops<Cuda>(m);
  register_contact_ops<Cuda>(m);
  register_contact_adjoint<Cuda>(m);
  register_rigid_motion<Cuda>(m);
}

}  // namespace pd
