#include "cuda/multilevel/launch.cuh"

namespace pd {
template std::int64_t multilevel_bytes(const DeviceStep<double>&);
template void run_material_comparison(const StreamCall<double>&, void*, cudaStream_t);
template void run_multilevel(const StreamCall<double>&, void*, cudaStream_t);
template std::int64_t precondition_bytes(const PreconditionCall<double>&);
template void run_precondition(const PreconditionCall<double>&, void*, Stream);
}  // namespace pd
