// The kernels of `Multilevel` for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/multilevel/launch.cuh"

namespace pd {
template std::int64_t multilevel_bytes(const DeviceStep<double>&);
template void run_material_comparison(const StreamCall<double>&, void*, cudaStream_t);
template void run_multilevel(const StreamCall<double>&, void*, cudaStream_t);
}  // namespace pd
