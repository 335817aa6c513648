// All tasks of freeform patches, which every device must run.
#pragma once
#include "freeform/field_rays.h"
#include "freeform/frames.h"
#include "freeform/height.h"
#include "freeform/paper_field.h"
#include "freeform/rays.h"
#include "freeform/surface.h"

// X(task)
#define PD_FREEFORM_TASKS(X) \
  X(Height)                  \
  X(HeightSamples)           \
  X(HeightEntries)           \
  X(HeightQuadrics)          \
  X(CornerSum)               \
  X(Surface)                 \
  X(SurfaceSamples)          \
  X(SurfacePose)             \
  X(PaperFieldValues)        \
  X(PaperFieldSamples)       \
  X(PaperFieldVertices)      \
  X(PaperFieldEntries)       \
  X(PaperFieldQuadrics)      \
  X(Deformation)             \
  X(DeformationGradients)    \
  X(DeformationPoints)       \
  X(DeformationRest)         \
  X(Frames)                  \
  X(FramesGradients)         \
  X(FramesWeights)           \
  X(CellBoxes)               \
  X(JoinedBoxes)             \
  X(PosedPatches)            \
  X(GatheredBumps)           \
  X(GridHeights)             \
  X(GridPoints)              \
  X(SurfaceRays)             \
  X(FieldBoxes)              \
  X(FieldRays)
