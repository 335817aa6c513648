#include "cuda/fused/launch.cuh"

namespace pd {
template std::int64_t fused_bytes(const DeviceStep<float>&);
template void run_fused(const DeviceStep<float>&, void*, Stream);

int largest_cluster() { return largest_cluster_with<float>(); }
}  // namespace pd
