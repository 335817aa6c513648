// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_conjugate.cuh"

namespace pd {
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<float>&);
template void run_mixed_conjugate(const MixedConjugate<float>&, void*, Stream);
}  // namespace pd
