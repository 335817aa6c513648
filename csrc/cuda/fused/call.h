// Arguments and memory layout of the fused kernel.
#pragma once
#include "cuda/common/inputs.h"
#include "cuda/common/launch.h"
#include "cuda/common/team.h"
#include "cuda/elements/stencils.h"
#include "cuda/fused/halo.h"
#include "cuda/rigid/rounds.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

// Per-slot arrays that elements do not read, ordered by how often iterations read them. A grid's
// block keeps as many as fit in shared memory; a cluster's block keeps those of its own vertices.
enum VertexArray { array_u, array_before, array_target, array_origin, array_x, array_velocity };
constexpr int vertex_arrays = 6;
// Arrays that a single block keeps at most: all that iterations read, except x, which only contacts
// need.
constexpr int block_arrays = 4;

// Device memory of the teams.
template <class T>
struct FusedScratch {
  Quad<T>* vertex[vertex_arrays];  // [teams, slots]; arrays outside shared memory
  T* weights;                      // [teams, blocks, pair_weights, 32]
  Piece* pieces;                   // [teams, patches, pieces]
  // [teams, count_rows, PartSums::count]
  double* part_sum;
  TaggedWord* messages;     // grid: [teams, 2, slots, words] forces on shared vertices
  TaggedWord* sums;         // grid: [teams, 2, patches, sums_count]
  ContactForces<T> forces;  // of the teams
};

template <class T>
struct FusedCall {
  DeviceStep<T> step;
  FusedScratch<T> scratch;
  int teams;
  int kept;  // vertex arrays in shared memory
};

// The same for a scene with stencils.
template <class T>
struct MixedFusedCall : FusedCall<T> {
  StencilWork<T> stencils;
};

// Shared memory of a block outside a cluster.
template <class T>
PD_HD std::size_t fused_shared_bytes(const DeviceStep<T>& step) {
  const bool many = step.plan.kernel == int(DeviceKernel::grid);
  return pd::fused_shared_bytes(sizeof(T), many, step.plan.most_slots, step.plan.most_entries,
                                step.material.planes_count, step.material.spheres_count);
}

// Layout of a block's shared memory behind Control. Cluster: sums, energies, positions, entries,
// spheres, planes, vertex arrays. Others: positions, entries, spheres, planes, vertex arrays.
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

// Decisions of the leading warp for its block.
template <class T>
struct Control {
  Progress progress;
  T omega;
  // of even and odd iterations, in a cluster and with a tolerance
  T omega_by_parity[2];
  // cluster: position of the mesh's first vertex when a call begins
  Vec3<T> anchor;
  TeamTotals totals;
};

}  // namespace pd::inline PD_TARGET
