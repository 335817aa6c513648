// Scenes of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/contact_conjugate.cuh"

namespace pd {
template std::int64_t contact_conjugate_bytes(const MixedConjugate<float>&);
template void run_contact_conjugate(const MixedConjugate<float>&, void*, Stream);
}  // namespace pd
