// Every standard header that the kernels use. Included before the instruction set changes, so that none of their
// inline functions is compiled for instructions that the machine may lack.
#pragma once
#include <algorithm>
#include <atomic>
#include <cfloat>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

#include "cpu/dispatch.h"
#include "threads/team.h"
#include "views/views.h"
#if defined(__x86_64__)
#include <immintrin.h>
#endif
