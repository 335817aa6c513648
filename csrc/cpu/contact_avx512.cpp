#include "cpu/target/avx512.h"
#ifdef PD_TARGET
#include "cpu/contact/kernels.h"
#pragma GCC pop_options
#endif
