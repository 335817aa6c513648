// The macros that let a function build for both devices.
#pragma once

#if defined(__CUDACC__)
#define PD_HD __host__ __device__ __forceinline__
#define PD_COLD __host__ __device__ __noinline__    // rarely called: keeps its registers to itself
#define PD_CALLED __host__ __device__ __noinline__  // too long to be copied to its callers
#define PD_UNROLL _Pragma("unroll")
#define PD_ROLLED _Pragma("unroll 1")
#define PD_UNROLL_4 _Pragma("unroll 4")
#else
#define PD_HD [[gnu::always_inline]] inline
#define PD_COLD [[gnu::noinline, gnu::cold]]
#define PD_CALLED [[gnu::noinline]]
#define PD_UNROLL _Pragma("GCC unroll 8")
#define PD_ROLLED _Pragma("GCC unroll 1")
#define PD_UNROLL_4 _Pragma("GCC unroll 4")
#endif
