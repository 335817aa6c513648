#include "cuda/adjoint/conjugate_gradients.cuh"
#include "cuda/adjoint/system.cuh"
#include "cuda/common/report.cuh"

namespace pd {
template std::int64_t field_bytes(const DeviceField<double>&);
template void run_field(const DeviceField<double>&, void*, Stream);
template std::int64_t conjugate_bytes(const DeviceConjugate<double>&);
template void run_conjugate(const DeviceConjugate<double>&, void*, Stream);
template void run_adjoint_system(const DeviceAdjointSystem<double>&, Stream);
template void run_contact_gradients(const DeviceContactGradients<double>&, Stream);
template void run_adjoint_result(const AdjointResultCall<double>&, Stream);
template void run_vertex_sum(const VertexSumCall<double>&, Stream);
template void run_report(const DeviceReport<double>&, Stream);
template void run_rotation(const RotationCall<double>&, Stream);
}  // namespace pd
