#include "cpu/target/portable.h"

#include "cpu/adjoint/contact_kernels.h"
