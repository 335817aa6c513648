// Scenes of stencils and of tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/mixed_fields.cuh"

namespace pd {
template std::int64_t mixed_field_bytes(const MixedField<double>&);
template void run_mixed_field(const MixedField<double>&, void*, Stream);
}  // namespace pd
