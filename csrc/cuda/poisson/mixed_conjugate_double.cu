// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_conjugate.cuh"

namespace pd {
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<double>&);
template void run_mixed_conjugate(const MixedConjugate<double>&, void*, Stream);
}  // namespace pd
