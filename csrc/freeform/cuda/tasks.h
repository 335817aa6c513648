// Tasks of freeform patches as functions, without torch or CUDA headers. Calls enqueue work on a
// stream and return.
#pragma once
#include "freeform/tasks.h"

namespace pd::freeform {

using Stream = void*;  // cudaStream_t

#define PD_DECLARE(Task)                                              \
  void run_task(const Task<float>& task, Index count, Stream stream); \
  void run_task(const Task<double>& task, Index count, Stream stream);
PD_FREEFORM_TASKS(PD_DECLARE)
#undef PD_DECLARE

}  // namespace pd::freeform
