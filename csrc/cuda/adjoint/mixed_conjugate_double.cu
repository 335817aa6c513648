#include "cuda/adjoint/mixed_conjugate.cuh"

namespace pd {
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<double>&);
template void run_mixed_conjugate(const MixedConjugate<double>&, void*, Stream);
}  // namespace pd
