// Writes the stencils of the patches into the arrays of views/gpu_stencils.def.
#pragma once

#include "plan/gpu/bank_conflicts.h"
#include "plan/gpu/build.h"
#include "plan/gpu/patch.h"

#include <vector>

namespace pd {

// Makes the arrays, empty without stencils, and numbers the blocks.
void number_stencils(DeviceMeshPlan& plan, const MeshElements& elements,
                     const std::vector<MeshPatch>& patches);

// Fills the blocks of a patch; `choice` has given entries to its pairs.
void fill_stencils(DeviceMeshPlan& plan, const MeshElements& elements, const MeshPatch& patch,
                   int number, EntryChoice& choice);

}  // namespace pd
