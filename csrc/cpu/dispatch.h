// Which compiled instruction set this machine runs.
#pragma once
#include "plan/views.h"

#include <string>
#include <vector>

namespace pd {

// Fastest that the processor supports; the environment variable TORCHPD_SIMD names a slower one, to test it.
const Kernels& kernels();

std::vector<std::string> supported_simd();

}  // namespace pd
