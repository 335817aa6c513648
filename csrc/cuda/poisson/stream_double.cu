// The kernels of "stream" for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/stream/contact_runner.cuh"

namespace pd {
template std::int64_t stream_bytes(const DeviceStep<double>&);
template void run_stream(const DeviceStep<double>&, void*, Stream);
template std::int64_t mixed_stream_bytes(const MixedStep<double>&);
template void run_mixed_stream(const MixedStep<double>&, void*, Stream);
template std::int64_t contact_stream_bytes(const WithContact<DeviceStep<double>>&);
template void run_contact_stream(const WithContact<DeviceStep<double>>&, void*, Stream);
template std::int64_t contact_mixed_bytes(const WithContact<MixedStep<double>>&);
template void run_contact_mixed(const WithContact<MixedStep<double>>&, void*, Stream);
}  // namespace pd
