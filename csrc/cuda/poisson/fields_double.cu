// Elastic fields and the adjoint for scenes with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/adjoint/conjugate_gradients.cuh"

namespace pd {
template std::int64_t field_bytes(const DeviceField<double>&);
template void run_field(const DeviceField<double>&, void*, Stream);
template std::int64_t conjugate_bytes(const DeviceConjugate<double>&);
template void run_conjugate(const DeviceConjugate<double>&, void*, Stream);
}  // namespace pd
