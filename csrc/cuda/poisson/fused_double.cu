// The fused kernels for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/fused/launch.cuh"

namespace pd {
template FusedKernel<double> fused_kernel_for<double, true, true>(Blocks, bool, int);
template std::int64_t fused_bytes(const DeviceStep<double>&);
template void run_fused(const DeviceStep<double>&, void*, Stream);
}  // namespace pd
