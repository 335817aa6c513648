#include "cpu/target/portable.h"

#include "cpu/contact/kernels.h"
