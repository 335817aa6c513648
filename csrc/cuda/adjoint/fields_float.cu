#include "cuda/adjoint/conjugate_gradients.cuh"
#include "cuda/adjoint/system.cuh"
#include "cuda/common/report.cuh"

namespace pd {
template std::int64_t field_bytes(const DeviceField<float>&);
template void run_field(const DeviceField<float>&, void*, Stream);
template std::int64_t conjugate_bytes(const DeviceConjugate<float>&);
template void run_conjugate(const DeviceConjugate<float>&, void*, Stream);
template void run_adjoint_system(const DeviceAdjointSystem<float>&, Stream);
template void run_contact_gradients(const DeviceContactGradients<float>&, Stream);
template void run_adjoint_result(const AdjointResultCall<float>&, Stream);
template void run_vertex_sum(const VertexSumCall<float>&, Stream);
template void run_report(const DeviceReport<float>&, Stream);
template void run_rotation(const RotationCall<float>&, Stream);
}  // namespace pd
