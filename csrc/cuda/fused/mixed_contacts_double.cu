#include "cuda/fused/mixed_kernels.cuh"

namespace pd {
template MixedKernel<double> mixed_kernel_for<double, true, true>(bool);
}  // namespace pd
