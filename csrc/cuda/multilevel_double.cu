#include "cuda/multilevel.cuh"

namespace pd {
template std::int64_t outer_bytes(const DeviceStep<double>&);
template void run_comparison(const StreamCall<double>&, void*, cudaStream_t);
template void run_outer(const StreamCall<double>&, void*, cudaStream_t);
template std::int64_t precondition_bytes(const PreconditionCall<double>&);
template void run_precondition(const PreconditionCall<double>&, void*, Stream);
}  // namespace pd
