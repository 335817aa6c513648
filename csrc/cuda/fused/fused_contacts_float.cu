#include "cuda/fused/kernels.cuh"

namespace pd {
template FusedKernel<float> fused_kernel_for<float, true, true>(Blocks, bool, int);
}  // namespace pd
