// Makes the patches of a plan for a GPU, each by its own numbers: slots, pairs, entries.
#pragma once

#include "plan/pairing.h"
#include "plan/partition.h"

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <vector>

namespace pd {

constexpr int lanes = 32;
constexpr std::int64_t none = 65535;                      // entries of a patch count up to one less
constexpr std::int64_t slot_step = 8, most_slots = 8192;  // in pair_corner
// numbers of kernels, as DeviceKernel has them
constexpr int block_kernel = 0, cluster_kernel = 1, grid_kernel = 2, stream_kernel = 3;

struct Mesh {
  const double* positions;
  const std::int64_t* tets;
  Partition partition;
  Numbering numbering;
  std::vector<std::int32_t> owner;  // of a cluster: the patch of each vertex
  int kernel;

  // The patch that counts a tetrahedron, where several work it out.
  std::int32_t counted_by(std::int32_t tet) const {
    const std::int64_t* v = tets + 4 * std::int64_t(tet);
    return std::min({owner[v[0]], owner[v[1]], owner[v[2]], owner[v[3]]});
  }
};

// A patch by its own numbers.
struct MeshPatch {
  std::vector<std::int32_t> vertex;  // user's vertex in each slot
  std::vector<std::int32_t> first;   // entry of each slot
  std::vector<std::int32_t> forces;  // corners of pairs that each slot adds up
  std::vector<Pair> pairs;           // user's tetrahedra, corners are slots
  std::int64_t outer = 0;            // pairs past which none touches a shared vertex
  std::int64_t entries = 0;
  bool piped = false;  // whether warps read and write entries as cuda/pipeline.h does

  std::int64_t blocks() const { return (std::ssize(pairs) + lanes - 1) / lanes; }
};

// Throws std::invalid_argument when one has more numbers than 16 bits can count.
std::vector<MeshPatch> make_patches(const Mesh& mesh, std::int64_t vertices);

}  // namespace pd
