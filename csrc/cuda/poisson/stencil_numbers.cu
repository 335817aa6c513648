// The numbers of a step of stencils beside tetrahedra with Poisson's ratio, see cuda/elements/group_lanes.h.
#define PD_TARGET poisson
#define PD_POISSON
#include "cuda/common/stencil_numbers.cu"
