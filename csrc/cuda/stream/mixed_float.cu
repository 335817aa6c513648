#include "cuda/stream/mixed_passes.cuh"

namespace pd {
template void allow_mixed_passes<float, true>(std::size_t);
template void allow_mixed_passes<float, false>(std::size_t);
template void run_mixed_pass<float, true>(Visit, const MixedStreamCall<float>&, std::int64_t,
                                          std::size_t, int, cudaStream_t);
template void run_mixed_pass<float, false>(Visit, const MixedStreamCall<float>&, std::int64_t,
                                           std::size_t, int, cudaStream_t);
template void run_mixed_begin(const MixedStreamCall<float>&, std::int64_t, cudaStream_t);
template void run_mixed_weights(const StreamCall<float>&, std::int64_t, WeightKind, cudaStream_t);
}  // namespace pd
