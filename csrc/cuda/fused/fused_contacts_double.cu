#include "cuda/fused/kernels.cuh"

namespace pd {
template FusedKernel<double> fused_kernel_for<double, true, true>(Blocks, bool, int);
}  // namespace pd
