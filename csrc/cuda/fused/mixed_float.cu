#include "cuda/fused/mixed_launch.cuh"

namespace pd {
template std::int64_t mixed_block_bytes(const MixedStep<float>&);
template void run_mixed_block(const MixedStep<float>&, void*, Stream);
}  // namespace pd
