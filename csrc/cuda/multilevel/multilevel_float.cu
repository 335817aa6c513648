#include "cuda/multilevel/launch.cuh"

namespace pd {
template std::int64_t multilevel_bytes(const DeviceStep<float>&);
template void run_material_comparison(const StreamCall<float>&, void*, cudaStream_t);
template void run_multilevel(const StreamCall<float>&, void*, cudaStream_t);
template std::int64_t precondition_bytes(const PreconditionCall<float>&);
template void run_precondition(const PreconditionCall<float>&, void*, Stream);
}  // namespace pd
