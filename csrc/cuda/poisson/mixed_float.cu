// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_conjugate.cuh"
#include "cuda/adjoint/mixed_fields.cuh"
#include "cuda/fused/mixed_launch.cuh"
#include "cuda/stream/mixed_passes.cuh"

namespace pd {
template MixedKernel<float> mixed_kernel_for<float, true, true>(bool);
template std::int64_t mixed_block_bytes(const MixedStep<float>&);
template void run_mixed_block(const MixedStep<float>&, void*, Stream);
template void allow_mixed_passes<float, true>(std::size_t);
template void allow_mixed_passes<float, false>(std::size_t);
template void run_mixed_pass<float, true>(Visit, const MixedStreamCall<float>&, std::int64_t,
                                          std::size_t, int, cudaStream_t);
template void run_mixed_pass<float, false>(Visit, const MixedStreamCall<float>&, std::int64_t,
                                           std::size_t, int, cudaStream_t);
template void run_mixed_weights(const StreamCall<float>&, std::int64_t, WeightKind, cudaStream_t);
template std::int64_t mixed_field_bytes(const MixedField<float>&);
template void run_mixed_field(const MixedField<float>&, void*, Stream);
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<float>&);
template void run_mixed_conjugate(const MixedConjugate<float>&, void*, Stream);
}  // namespace pd
