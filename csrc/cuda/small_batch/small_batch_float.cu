#include "cuda/small_batch/launch.cuh"

namespace pd {
template bool takes_small_batch(const DeviceStep<float>&);
template std::int64_t small_batch_bytes(const DeviceStep<float>&);
template void run_small_batch(const DeviceStep<float>&, void*, Stream);
}  // namespace pd
