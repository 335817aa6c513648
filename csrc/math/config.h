// What every physics header needs: the one macro that lets it build for both devices, and the name of its target.
#pragma once

#if defined(__CUDACC__)
#define PD_HD __host__ __device__ __forceinline__
#else
#define PD_HD [[gnu::always_inline]] inline
#endif

// Each instruction set compiles the headers once. An inline namespace of its own keeps the linker
// from merging, say, an AVX-512 instance of a template into the plain x86-64 code.
#if !defined(PD_TARGET)
#define PD_TARGET generic
#endif
