// The end of every function that the table of kernels points to.
#pragma once
#include "cpu/system.h"

namespace pd::inline PD_TARGET {

// Clears the upper vector registers for code compiled for older instructions; the build turns the compiler's own off.
struct CleanRegisters {
  ~CleanRegisters() {
#if PD_VECTOR_BYTES >= 32
    _mm256_zeroupper();
#endif
  }
};

}  // namespace pd::inline PD_TARGET
