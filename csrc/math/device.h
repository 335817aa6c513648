// The macros that let a function build for both devices.
#pragma once

#if defined(__CUDACC__)
#define PD_HD __host__ __device__ __forceinline__
#define PD_COLD __host__ __device__ __noinline__  // seldom called: keeps its registers to itself
#else
#define PD_HD [[gnu::always_inline]] inline
#define PD_COLD [[gnu::noinline, gnu::cold]]
#endif
