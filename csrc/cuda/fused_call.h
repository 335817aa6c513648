// What the fused kernel is given, and what it keeps where.
#pragma once
#include "cuda/halo.h"
#include "cuda/inputs.h"
#include "cuda/launch.h"
#include "cuda/rigid.h"
#include "cuda/team.h"
#include "plan/shared_memory.h"

namespace pd::inline PD_TARGET {

// What a team knows of every slot and elements do not need, in the order of how often iterations ask for it. A block of a grid
// keeps as many as fit in its shared memory, a cluster's those of its own vertices.
enum VertexArray { array_u, array_before, array_target, array_origin, array_x, array_velocity };
constexpr int vertex_arrays = 6;
// Those that a block without others keeps at most: what iterations ask for, but for x where there are contacts.
constexpr int block_arrays = 4;

// Device memory of the teams.
template <class T>
struct FusedScratch {
  Quad<T>* vertex[vertex_arrays];  // [teams, slots] those that are not in shared memory
  T* weights;                      // [teams, blocks, 2, 32] w V
  Piece<T>* pieces;                // [teams, patches, pieces]
  double* part_sum;  // [teams, parts, PartSums::count] of the vertices that a patch owns of a piece
  TaggedWord* messages;  // of a grid: [teams, 2, slots, words] forces on shared vertices
  TaggedWord* sums;      // of a grid: [teams, 2, patches, sums_count]
};

template <class T>
struct FusedCall {
  DeviceStep<T> step;
  FusedScratch<T> scratch;
  int teams;
  int kept;  // vertex arrays in shared memory
};

// Shared memory of a block that is in no cluster.
template <class T>
PD_HD std::size_t fused_shared_bytes(const DeviceStep<T>& step) {
  const bool many = step.plan.kernel == int(DeviceKernel::grid);
  return pd::fused_shared_bytes(sizeof(T), many, step.plan.most_slots, step.plan.most_entries,
                                step.material.planes_count, step.material.spheres_count);
}

// Where the parts of a block's shared memory lie behind what it decides: of a cluster sums, energies and positions, then entries, planes and
// balls, then vertex arrays; else positions first.
constexpr std::size_t cluster_sums_begin = fused_control_bytes;
constexpr std::size_t cluster_energy_begin = cluster_sums_begin + cluster_sums_bytes;
constexpr std::size_t halo_begin = cluster_energy_begin + cluster_energy_bytes;

template <class T>
PD_HD std::size_t vertices_begin(const DeviceStep<T>& step, bool cluster) {
  if (!cluster) return aligned(fused_shared_bytes(step));
  return cluster_vertices_begin(sizeof(T), step.plan.most_slots, step.plan.most_entries,
                                step.material.planes_count, step.material.spheres_count);
}
template <class T>
PD_HD std::size_t cluster_shared_bytes(const DeviceStep<T>& step) {
  return pd::cluster_shared_bytes(sizeof(T), step.plan.most_slots, step.plan.most_entries,
                                  step.plan.most_interior, step.material.planes_count,
                                  step.material.spheres_count);
}

// What the leading warp of a block decides for it.
template <class T>
struct Control {
  Progress progress;
  T omega;
  // of even and of odd iterations, of a cluster and where they may stop
  T omega_by_parity[2];
  // of a cluster: where the first vertex of the mesh is when a call begins
  Vec3<T> anchor;
  TeamTotals totals;
};

}  // namespace pd::inline PD_TARGET
