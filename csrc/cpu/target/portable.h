// The instructions that every processor of the architecture has: SSE2 on x86-64, NEON on aarch64.
#pragma once
#if defined(__GNUC__) && !defined(__clang__)
// GCC 13 does not finish these kernels within nine minutes with -O3; with -O2 it takes one.
#pragma GCC optimize("O2")
#endif
#include "cpu/system.h"

#define PD_NO_FMA  // x86-64 has it only since AVX2, and a call to the library would be slow
#define PD_TARGET portable
#define PD_VECTOR_BYTES 16
#define PD_KERNELS kernels_portable
#define PD_NAME "portable"
