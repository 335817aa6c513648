#include "cpu/target/avx512.h"
#ifdef PD_TARGET
#include "cpu/adjoint/kernels.h"
#pragma GCC pop_options
#endif
