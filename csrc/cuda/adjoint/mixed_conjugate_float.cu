#include "cuda/adjoint/mixed_conjugate.cuh"

namespace pd {
template std::int64_t mixed_conjugate_bytes(const MixedConjugate<float>&);
template void run_mixed_conjugate(const MixedConjugate<float>&, void*, Stream);
}  // namespace pd
