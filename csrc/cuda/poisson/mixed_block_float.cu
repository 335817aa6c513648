// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/fused/mixed_launch.cuh"

namespace pd {
template MixedKernel<float> mixed_kernel_for<float, true, true>(bool);
template std::int64_t mixed_block_bytes(const MixedStep<float>&);
template void run_mixed_block(const MixedStep<float>&, void*, Stream);
}  // namespace pd
