// Arguments and memory layout of the small-batch kernel.
#pragma once
#include "cuda/common/inputs.h"
#include "cuda/common/reductions.h"
#include "cuda/rigid/rounds.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

// State of an environment's solve, in shared memory.
template <class T>
struct EnvironmentControl {
  Progress progress;
  T omega[2];  // of even and odd iterations

  PD_DEVICE void compute_omega(int k) { omega[k & 1] = T(progress.schedule.next(k)); }
};

// Device memory of the blocks.
template <class T>
struct SmallBatchScratch {
  Quad<T>*x, *velocity;     // [blocks, per_block, slots]
  T* weights;               // [blocks, per_block, blocks of pairs, 2, 32] w V
  Piece* pieces;            // [blocks, per_block, pieces]
  double* part_sum;         // [blocks, per_block, count_rows, PartSums::count]
  ContactForces<T> forces;  // [blocks, per_block]
};

// Step from one item of a thread to its next: whole environments, and the remainder.
struct Stride {
  int whole, rest;

  Stride() = default;
  Stride(int threads, int each) : whole(threads / each), rest(threads % each) {}
};

template <class T>
struct SmallBatchCall {
  DeviceStep<T> step;
  SmallBatchScratch<T> scratch;
  int per_block;  // environments per block
  Stride pair_stride, slot_stride;
  T relaxation;  // from the settings, in T
};

// Layout of a block's shared memory: EnvironmentControl; position, target, u, before and origin of
// every slot; entries; energies of pairs; three numbers of every slot; spheres and planes.
template <class T>
struct SmallBatchLayout {
  std::size_t vectors, entries, energies, contacts, bytes;

  PD_HD SmallBatchLayout(const DeviceStep<T>& step, int per_block) {
    const DevicePlan<T>& plan = step.plan;
    const std::size_t many = per_block, slots = many * plan.most_slots;
    vectors = aligned(many * sizeof(EnvironmentControl<T>));
    entries = vectors + 5 * sizeof(Quad<T>) * slots;
    energies = entries + sizeof(Quad<T>) * many * plan.most_entries;
    contacts = aligned(energies + sizeof(T) * (many * plan.most_pairs + sums_count * slots));
    bytes = contacts + many * (step.material.spheres_count * sizeof(Sphere<T>) +
                               step.material.planes_count * sizeof(Plane<T>));
  }
};

}  // namespace pd::inline PD_TARGET
