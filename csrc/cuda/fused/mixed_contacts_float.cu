#include "cuda/fused/mixed_kernels.cuh"

namespace pd {
template MixedKernel<float> mixed_kernel_for<float, true, true>(bool);
}  // namespace pd
