// Builds the patches of a GPU plan in local numbers: slots, pairs and entries.
#pragma once

#include "plan/gpu/pairing.h"
#include "plan/mesh/partition.h"

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <vector>

namespace pd {

constexpr int lanes = 32;
constexpr std::int64_t none = 65535;  // marks a missing entry; a patch has fewer entries
constexpr std::int64_t slot_step = 8, most_slots = 8192;  // in pair_corner
// numbers of kernels, as in DeviceKernel
constexpr int block_kernel = 0, cluster_kernel = 1, grid_kernel = 2, stream_kernel = 3;

struct Mesh {
  const MeshElements& elements;
  Partition partition;
  Numbering numbering;
  std::vector<std::int32_t> owner;  // cluster: the patch that owns each vertex
  int kernel;
  std::vector<std::int32_t> group =
      {};  // number of each tetrahedron's group, in runs of the partition; none: pairs are free

  // The patch that counts the energy of a tetrahedron, if several compute it.
  std::int32_t counted_by(std::int32_t tet) const {
    const std::int64_t* v = elements.tets + 4 * std::int64_t(tet);
    return std::min({owner[v[0]], owner[v[1]], owner[v[2]], owner[v[3]]});
  }
};

// Stencils of one kind in a patch.
struct PatchStencils {
  int group = 0;                     // of MeshElements
  std::vector<std::int32_t> number;  // in the group
  std::vector<std::int32_t> corner;  // slots

  std::int64_t blocks() const { return (std::ssize(number) + lanes - 1) / lanes; }
};

// The entries of a patch.
struct Entries {
  std::vector<std::int32_t> first;   // of each slot
  std::vector<std::int32_t> forces;  // entries that each slot sums
  std::int64_t entries = 0;

  // Every slice of eight slots reserves as many entries as its slot with the most forces.
  void place(bool piped);
};

// The rows of the quadratic stencils in a patch, see views/gpu_step_rows.def. A term counts stencils from the patch's first.
struct PatchRows {
  std::vector<std::int32_t> slot;         // of each row, 32 in a block; -1: padding
  std::vector<std::int32_t> width;        // pairs of neighbours of each block
  std::vector<std::int32_t> neighbour;    // row_neighbour
  std::vector<std::int32_t> count, term;  // terms of each t
  std::vector<std::int32_t> diagonal_count, diagonal_term;  // and of each diagonal
};

// A patch in local numbers.
struct MeshPatch : Entries {
  std::vector<std::int32_t> vertex;  // user's vertex of each slot
  std::vector<Pair> pairs;           // user's tetrahedra; corners are slots
  std::vector<PatchStencils> stencils;
  std::int64_t outer = 0;    // number of leading pairs that may touch shared vertices
  std::int64_t coupled = 0;  // number of leading pairs that average with their neighbour
  Entries step;              // with rows: those of a step
  PatchRows rows;
  bool piped = false;  // whether cuda/stream/pipeline.h reads and writes the entries

  std::int64_t blocks() const { return (std::ssize(pairs) + lanes - 1) / lanes; }
  std::int64_t elements() const {
    std::int64_t count = std::ssize(pairs);
    for (const PatchStencils& own : stencils) count += std::ssize(own.number);
    return count;
  }
};

// Throws std::invalid_argument when a patch exceeds a 16-bit count.
std::vector<MeshPatch> make_patches(const Mesh& mesh, std::int64_t vertices);

}  // namespace pd
