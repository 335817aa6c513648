#include "freeform/cuda/tasks.cuh"

namespace pd::freeform {
#define PD_DEFINE(Task)                                                \
  void run_task(const Task<float>& task, Index count, Stream stream) { \
    launch_items(task, count, stream);                                 \
  }
PD_FREEFORM_TASKS(PD_DEFINE)
#undef PD_DEFINE
}  // namespace pd::freeform
