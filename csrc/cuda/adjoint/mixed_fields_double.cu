#include "cuda/adjoint/mixed_fields.cuh"

namespace pd {
template std::int64_t mixed_field_bytes(const MixedField<double>&);
template void run_mixed_field(const MixedField<double>&, void*, Stream);
}  // namespace pd
