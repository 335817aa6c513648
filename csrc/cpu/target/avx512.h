// The instructions of AVX-512. Included before everything else.
#pragma once
// the intrinsics of GCC 12 warn about themselves
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#pragma GCC diagnostic ignored "-Wuninitialized"
#include "cpu/system.h"

// clang has no such pragma, and builds the portable level alone
#if defined(__x86_64__) && !defined(__clang__)
#pragma GCC push_options
#pragma GCC target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,bmi,bmi2,lzcnt,popcnt")
#define PD_TARGET avx512
#define PD_VECTOR_BYTES 64  // GCC sets its own macros too late for a pragma
#define PD_KERNELS kernels_avx512
#define PD_NAME "avx512"
#endif
