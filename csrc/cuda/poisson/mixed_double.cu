// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_conjugate.cuh"
#include "cuda/adjoint/mixed_fields.cuh"
#include "cuda/fused/mixed_launch.cuh"
#include "cuda/stream/mixed_passes.cuh"

namespace pd {
template MixedKernel<double> mixed_kernel_for<double, true, true>(bool);
template std::int64_t mixed_block_bytes(const MixedStep<double>&);
template void run_mixed_block(const MixedStep<double>&, void*, Stream);
template void allow_mixed_passes<double, true>(std::size_t);
template void allow_mixed_passes<double, false>(std::size_t);
template void run_mixed_pass<double, true>(Visit, const MixedStreamCall<double>&, std::int64_t,
                                           std::size_t, int, cudaStream_t);
template void run_mixed_pass<double, false>(Visit, const MixedStreamCall<double>&, std::int64_t,
                                            std::size_t, int, cudaStream_t);
template void run_mixed_weights(const StreamCall<double>&, std::int64_t, WeightKind, cudaStream_t);
template std::int64_t mixed_field_bytes(const MixedField<double>&);
template void run_mixed_field(const MixedField<double>&, void*, Stream);
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<double>&);
template void run_mixed_conjugate(const MixedConjugate<double>&, void*, Stream);
}  // namespace pd
