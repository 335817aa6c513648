// Common to every physics header: the macro for both devices, and the name of the target.
#pragma once
#include "math/device.h"

// Each instruction set compiles the headers once. An inline namespace of its own keeps the linker from merging, say,
// an AVX-512 instance of a template into the plain x86-64 code.
#if !defined(PD_TARGET)
#define PD_TARGET generic
#endif
