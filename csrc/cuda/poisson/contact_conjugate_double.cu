// Scenes of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/contact_conjugate.cuh"

namespace pd {
template std::int64_t contact_conjugate_bytes(const MixedConjugate<double>&);
template void run_contact_conjugate(const MixedConjugate<double>&, void*, Stream);
}  // namespace pd
