// Entry points of the kernels for scenes with Poisson's ratio: those of cuda/common/launch.h, compiled a second time,
// see cuda/elements/group_lanes.h.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/contact/launch.h"

namespace pd::poisson {

template <class T>
std::int64_t fused_bytes(const DeviceStep<T>& call);
template <class T>
void run_fused(const DeviceStep<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t stream_bytes(const DeviceStep<T>& call);
template <class T>
void run_stream(const DeviceStep<T>& call, void* memory, Stream stream);
template <class T>
std::int64_t step_bytes(const DeviceStep<T>& call) {
  return call.plan.kernel == int(DeviceKernel::stream) ? poisson::stream_bytes(call)
                                                       : poisson::fused_bytes(call);
}

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
  return call.plan.kernel == int(DeviceKernel::stream) ? poisson::mixed_stream_bytes(call)
                                                       : poisson::mixed_block_bytes(call);
}

template <class T>
std::int64_t contact_stream_bytes(const WithContact<DeviceStep<T>>& call);
template <class T>
void run_contact_stream(const WithContact<DeviceStep<T>>& call, void* memory, Stream stream);
template <class T>
std::int64_t contact_mixed_bytes(const WithContact<MixedStep<T>>& call);
template <class T>
void run_contact_mixed(const WithContact<MixedStep<T>>& call, void* memory, Stream stream);

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
template <class T>
std::int64_t contact_conjugate_bytes(const MixedConjugate<T>& call);
template <class T>
void run_contact_conjugate(const MixedConjugate<T>& call, void* memory, Stream stream);

}  // namespace pd::poisson
