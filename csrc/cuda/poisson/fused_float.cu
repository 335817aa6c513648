// The fused kernels for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/fused/launch.cuh"

namespace pd {
template FusedKernel<float> fused_kernel_for<float, true, true>(Blocks, bool, int);
template std::int64_t fused_bytes(const DeviceStep<float>&);
template void run_fused(const DeviceStep<float>&, void*, Stream);
}  // namespace pd
