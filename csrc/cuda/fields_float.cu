#include "cuda/fields.cuh"

namespace pd {
template std::int64_t field_bytes(const DeviceField<float>&);
template void run_field(const DeviceField<float>&, void*, Stream);
template void run_rotation(const RotationCall<float>&, Stream);
}  // namespace pd
