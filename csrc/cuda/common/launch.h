// Entry points of the kernels, without torch or CUDA headers. The caller owns the memory; calls
// enqueue work on a stream and return.
#pragma once
#include "math/config.h"
#include "solver/adjoint/pair_views.h"
#include "views/vertex_sum.h"
#include "views/views.h"

#include <cstdint>

namespace pd {

// Kernel of a plan, stored in DevicePlan::kernel.
enum class DeviceKernel : int {
  // one launch for all iterations: one block per environment, or several small environments per block
  block = 0,
  // one launch for all iterations: one block per patch, with distributed shared memory
  cluster = 1,
  // one launch for all iterations: one block per patch
  grid = 2,
  // several launches per iteration
  stream = 3,
};

// Whether rest shapes are computed from stored rest positions instead of being stored themselves;
// see rest_of.
template <class T>
bool computes_rests(const DevicePlan<T>& plan) {
  return plan.kernel == int(DeviceKernel::stream);
}

using Stream = void*;  // cudaStream_t

// Optional parts of a scene: contacts, and connected pieces that pins leave free to move.
template <class T>
bool has_contacts(const DeviceStep<T>& call) {
  return call.material.planes_count + call.material.spheres_count > 0;
}
template <class T>
bool has_free_pieces(const DeviceStep<T>& call) {
  return call.plan.pieces > 0;
}

template <class T>
using DeviceField = FieldCall<T, DevicePlan<T>>;

template <class T>
using DeviceConjugate = ConjugateCall<T, DevicePlan<T>>;

template <class T>
using DeviceAdjointSystem = AdjointSystemCall<T, DevicePlan<T>>;

template <class T>
using DeviceContactGradients = ContactGradientsCall<T, DevicePlan<T>>;

template <class T>
using DeviceReport = ReportCall<T, DevicePlan<T>>;

// The same for scenes with stencils.
template <class T>
using MixedStep = Mixed<DeviceStep<T>>;
template <class T>
using MixedField = Mixed<DeviceField<T>>;
template <class T>
using MixedConjugate = Mixed<DeviceConjugate<T>>;

// Blocks of the largest cluster that the current device runs; 1 when the device or this build
// supports none.
int largest_cluster();

}  // namespace pd

namespace pd::inline PD_TARGET {

// Device memory in bytes, aligned to 256. Fused covers the kernels block, cluster and grid.
template <class T>
std::int64_t fused_bytes(const DeviceStep<T>& call);
template <class T>
void run_fused(const DeviceStep<T>& call, void* memory, Stream stream);
// The small-batch variant of kernel block, in float32: meshes so small that a block may hold
// several environments.
template <class T>
bool takes_small_batch(const DeviceStep<T>& call);
template <class T>
std::int64_t small_batch_bytes(const DeviceStep<T>& call);
template <class T>
void run_small_batch(const DeviceStep<T>& call, void* memory, Stream stream);

template <class T>
std::int64_t stream_bytes(const DeviceStep<T>& call);
template <class T>
void run_stream(const DeviceStep<T>& call, void* memory, Stream stream);

// The same for scenes with stencils, by the kernels block and stream.
template <class T>
std::int64_t mixed_block_bytes(const MixedStep<T>& call);
template <class T>
void run_mixed_block(const MixedStep<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t mixed_stream_bytes(const MixedStep<T>& call);
template <class T>
void run_mixed_stream(const MixedStep<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t mixed_step_bytes(const MixedStep<T>& call) {
  return call.plan.kernel == int(DeviceKernel::stream) ? mixed_stream_bytes(call)
                                                       : mixed_block_bytes(call);
}

// Device memory for a step of any kernel.
template <class T>
std::int64_t step_bytes(const DeviceStep<T>& call) {
  return call.plan.kernel == int(DeviceKernel::stream) ? stream_bytes(call) : fused_bytes(call);
}

template <class T>
std::int64_t field_bytes(const DeviceField<T>& call);
template <class T>
void run_field(const DeviceField<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t mixed_field_bytes(const MixedField<T>& call);
template <class T>
void run_mixed_field(const MixedField<T>& call, void* memory, Stream stream);

template <class T>
std::int64_t conjugate_bytes(const DeviceConjugate<T>& call);
template <class T>
void run_conjugate(const DeviceConjugate<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t mixed_conjugate_bytes(const MixedConjugate<T>& call);
template <class T>
void run_mixed_conjugate(const MixedConjugate<T>& call, void* memory, Stream stream);

// The same with contact between bodies, of a plan for kernel `stream`.
template <class T>
std::int64_t contact_conjugate_bytes(const MixedConjugate<T>& call);
template <class T>
void run_contact_conjugate(const MixedConjugate<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t pair_gradients_bytes(const PairGradientsCall<T>& call);
template <class T>
void run_pair_gradients(const PairGradientsCall<T>& call, void* memory, Stream stream);

// Memory for the pairs of all environments in progress, and at most that of one.
constexpr std::int64_t most_pair_bytes = std::int64_t(1) << 32;
template <class T>
std::int64_t bytes_of_pairs(const LoadedPairs<T>& pairs);

template <class T>
void run_adjoint_system(const DeviceAdjointSystem<T>& call, Stream stream);

template <class T>
void run_contact_gradients(const DeviceContactGradients<T>& call, Stream stream);
template <class T>
void run_adjoint_result(const AdjointResultCall<T>& call, Stream stream);
template <class T>
void run_vertex_sum(const VertexSumCall<T>& call, Stream stream);

template <class T>
void run_report(const DeviceReport<T>& call, Stream stream);

template <class T>
std::int64_t precondition_bytes(const PreconditionCall<T>& call);
template <class T>
void run_precondition(const PreconditionCall<T>& call, void* memory, Stream stream);

template <class T>
void run_rotation(const RotationCall<T>& call, Stream stream);

}  // namespace pd::inline PD_TARGET
