#include "cpu/target/portable.h"

#include "cpu/adjoint/kernels.h"
