#include "cuda/stream/runner.cuh"

namespace pd {
template std::int64_t stream_bytes(const DeviceStep<double>&);
template void run_stream(const DeviceStep<double>&, void*, Stream);
}  // namespace pd
