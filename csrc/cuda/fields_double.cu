#include "cuda/fields.cuh"

namespace pd {
template std::int64_t field_bytes(const DeviceField<double>&);
template void run_field(const DeviceField<double>&, void*, Stream);
template void run_rotation(const RotationCall<double>&, Stream);
}  // namespace pd
