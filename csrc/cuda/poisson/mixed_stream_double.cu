// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/stream/mixed_passes.cuh"

namespace pd {
template void allow_mixed_passes<double, true>(std::size_t);
template void allow_mixed_passes<double, false>(std::size_t);
template void run_mixed_pass<double, true>(Visit, const MixedStreamCall<double>&, std::int64_t,
                                           std::size_t, int, cudaStream_t);
template void run_mixed_pass<double, false>(Visit, const MixedStreamCall<double>&, std::int64_t,
                                            std::size_t, int, cudaStream_t);
template void run_mixed_begin(const MixedStreamCall<double>&, std::int64_t, cudaStream_t);
template void run_mixed_weights(const StreamCall<double>&, std::int64_t, WeightKind, cudaStream_t);
}  // namespace pd
