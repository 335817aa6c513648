#include "cuda/adjoint/contact_conjugate.cuh"
#include "cuda/adjoint/pair_gradients.cuh"

namespace pd {
template std::int64_t contact_conjugate_bytes(const MixedConjugate<double>&);
template void run_contact_conjugate(const MixedConjugate<double>&, void*, Stream);
template std::int64_t pair_gradients_bytes(const PairGradientsCall<double>&);
template void run_pair_gradients(const PairGradientsCall<double>&, void*, Stream);
template std::int64_t bytes_of_pairs(const LoadedPairs<double>&);
}  // namespace pd
