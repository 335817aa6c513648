// Quadratic stencils as rows of a matrix: the arrays of views/gpu_step_rows.def.
#pragma once

#include "plan/gpu/build.h"
#include "plan/gpu/patch.h"

#include <vector>

namespace pd {

// Whether a scene has stencils that a step takes as rows.
bool has_rows(const MeshElements& elements);

// Makes the rows of a patch whose stencils are in their final order, and the entries of its steps.
void make_rows(MeshPatch& patch, const MeshElements& elements);

// Makes the arrays, empty without rows, and numbers their blocks and terms; after number_stencils.
void number_rows(DeviceMeshPlan& plan, const MeshElements& elements,
                 const std::vector<MeshPatch>& patches);

// Fills the rows of a patch and the entries of its steps; after its stencils.
void fill_rows(DeviceMeshPlan& plan, const MeshElements& elements, const MeshPatch& patch,
               int number);

}  // namespace pd
