#include "cpu/target/portable.h"

#include "cpu/kernels.h"
