// The one macro that lets a function build for both devices.
#pragma once

#if defined(__CUDACC__)
#define PD_HD __host__ __device__ __forceinline__
#else
#define PD_HD [[gnu::always_inline]] inline
#endif
