// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_fields.cuh"

namespace pd {
template std::int64_t mixed_field_bytes(const MixedField<float>&);
template void run_mixed_field(const MixedField<float>&, void*, Stream);
}  // namespace pd
