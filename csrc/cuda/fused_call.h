// What the fused kernel is given, and what it keeps where.
#pragma once
#include "cuda/inputs.h"
#include "cuda/launch.h"
#include "cuda/mail.h"
#include "cuda/team.h"
#include "plan/shared_memory.h"

namespace pd::inline PD_TARGET {

// What a team knows of every slot and elements do not need, in the order of how often iterations ask for it. A block that has
// one of several patches keeps as many as fit in its shared memory, a cluster's all.
enum VertexArray { array_u, array_before, array_target, array_origin, array_x, array_velocity };
constexpr int vertex_arrays = 6;

// Device memory of the teams.
template <class T>
struct FusedScratch {
  Quad<T>* vertex[vertex_arrays];  // [teams, slots] those that are not in shared memory
  T* weights;                      // [teams, blocks, 2, 32] w V
  Quad<T>* shift;                  // [teams, patches, pieces]
  double* part_sum;                // [teams, parts, 4] of the vertices that a patch owns of a piece
  Word* letters;                   // of a grid: [teams, 2, slots, words] forces on shared vertices
  Word* sums;                      // of a grid: [teams, 2, patches, sums_count]
};

template <class T>
struct FusedCall {
  DeviceStep<T> step;
  FusedScratch<T> scratch;
  int teams;
  int kept;  // vertex arrays in shared memory
};

// Shared memory of a block, without a cluster's mail.
template <class T>
PD_HD std::size_t fused_shared_bytes(const DeviceStep<T>& step) {
  const bool many = step.plan.kernel != int(DeviceKernel::block);
  return pd::fused_shared_bytes(sizeof(T), many, step.plan.most_slots, step.plan.most_entries,
                                step.material.planes_count, step.material.spheres_count);
}

// Where the parts lie that a block of a cluster has behind those.
template <class T>
PD_HD std::size_t sums_begin(const DeviceStep<T>& step) {
  return aligned(fused_shared_bytes(step));
}
template <class T>
PD_HD std::size_t mail_begin(const DeviceStep<T>& step) {
  return sums_begin(step) + cluster_sums_bytes;
}
// `cluster`: behind the mail
template <class T>
PD_HD std::size_t vertices_begin(const DeviceStep<T>& step, bool cluster) {
  if (!cluster) return aligned(fused_shared_bytes(step));
  return mail_begin(step) + mail_bytes(sizeof(T), step.plan.most_shared, step.plan.patches);
}
template <class T>
PD_HD std::size_t cluster_shared_bytes(const DeviceStep<T>& step) {
  return pd::cluster_shared_bytes(sizeof(T), fused_shared_bytes(step), step.plan.most_slots,
                                  step.plan.most_shared, step.plan.patches);
}

// What the leading warp of a block decides for it.
template <class T>
struct Control {
  Progress progress;
  T omega;
  TeamTotals totals;
};

}  // namespace pd::inline PD_TARGET
