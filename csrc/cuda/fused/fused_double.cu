#include "cuda/fused/launch.cuh"

namespace pd {
template std::int64_t fused_bytes(const DeviceStep<double>&);
template void run_fused(const DeviceStep<double>&, void*, Stream);
}  // namespace pd
