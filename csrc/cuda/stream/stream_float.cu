#include "cuda/stream/contact_runner.cuh"

namespace pd {
template std::int64_t stream_bytes(const DeviceStep<float>&);
template void run_stream(const DeviceStep<float>&, void*, Stream);
template std::int64_t mixed_stream_bytes(const MixedStep<float>&);
template void run_mixed_stream(const MixedStep<float>&, void*, Stream);
template std::int64_t contact_stream_bytes(const WithContact<DeviceStep<float>>&);
template void run_contact_stream(const WithContact<DeviceStep<float>>&, void*, Stream);
template std::int64_t contact_mixed_bytes(const WithContact<MixedStep<float>>&);
template void run_contact_mixed(const WithContact<MixedStep<float>>&, void*, Stream);
}  // namespace pd
