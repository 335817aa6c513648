#include "cuda/several.cuh"

namespace pd {
template bool takes_several(const DeviceStep<float>&);
template std::int64_t several_bytes(const DeviceStep<float>&);
template void run_several(const DeviceStep<float>&, void*, Stream);
}  // namespace pd
