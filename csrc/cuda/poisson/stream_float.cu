// The kernels of "stream" for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/stream/runner.cuh"

namespace pd {
template std::int64_t stream_bytes(const DeviceStep<float>&);
template void run_stream(const DeviceStep<float>&, void*, Stream);
template std::int64_t mixed_stream_bytes(const MixedStep<float>&);
template void run_mixed_stream(const MixedStep<float>&, void*, Stream);
}  // namespace pd
