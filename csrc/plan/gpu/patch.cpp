#include "plan/gpu/patch.h"

#include "plan/gpu/bank_conflicts.h"
#include "threads/team.h"
#include "views/shared_memory.h"

#include <algorithm>
#include <cstddef>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>

namespace pd {

namespace {

constexpr int slice = entry_slice;
constexpr int small_pairs = 512;  // of a patch

[[noreturn]] void refuse(int patches, std::int64_t count, const char* what, std::int64_t most) {
  throw std::invalid_argument("patches = " + std::to_string(patches) +
                              " is too few: one of them would have at least " +
                              std::to_string(count) + " " + what + ", and 16 bits count up to " +
                              std::to_string(most) + "; take more patches");
}

// Orders the slots of a patch: interior vertices first, by descending number of forces, which
// leaves little padding between entries. A small patch has room for padding and mostly waits for
// others. Its shared vertices keep their global order, so that all patches read and write them in
// runs. Padding can reach several times the forces if a few vertices have many.
std::vector<std::int32_t> slots_of(const MeshPatch& patch, int number, const Numbering& numbering) {
  std::vector<std::int32_t> order(patch.vertex.size()), slot(order.size());
  for (std::size_t v = 0; v < order.size(); ++v) order[v] = std::int32_t(v);
  const bool small = std::ssize(patch.pairs) <= small_pairs;
  std::stable_sort(order.begin(), order.end(), [&](std::int32_t a, std::int32_t b) {
    const std::int32_t one = patch.vertex[a], two = patch.vertex[b];
    const bool shared = !numbering.is_inside(number, one);
    const bool other = !numbering.is_inside(number, two);
    if (shared != other) return other;
    return shared && small ? numbering.internal[one] < numbering.internal[two]
                           : patch.forces[a] > patch.forces[b];
  });
  for (std::size_t s = 0; s < order.size(); ++s) slot[order[s]] = std::int32_t(s);
  return slot;
}

template <class T>
void scatter(std::vector<T>& items, const std::vector<std::int32_t>& place) {
  std::vector<T> moved(items.size());
  for (std::size_t i = 0; i < items.size(); ++i) moved[place[i]] = items[i];
  items = std::move(moved);
}

// Every slice of eight slots reserves as many entries as its slot with the most forces.
void count_entries(MeshPatch& patch) {
  patch.first.resize(patch.forces.size());
  SliceBanks banks;
  for (std::size_t s = 0; s < patch.forces.size(); s += slice) {
    const std::size_t end = std::min(s + slice, patch.forces.size());
    if (patch.piped) patch.entries = banks.next(patch.entries);
    for (std::size_t i = s; i < end; ++i) patch.first[i] = std::int32_t(patch.entries + i - s);
    patch.entries += slice * *std::max_element(patch.forces.begin() + std::ptrdiff_t(s),
                                               patch.forces.begin() + std::ptrdiff_t(end));
  }
}

// Minimises bank conflicts. In a patch that is not small, pairs that touch shared vertices come in
// the first blocks.
void order_pairs(MeshPatch& patch, int number, const Numbering& numbering) {
  patch.outer = std::ssize(patch.pairs);
  if (patch.outer <= small_pairs) return reduce_bank_conflicts(patch.pairs);
  const auto is_outer = [&](const Pair& pair) {
    return std::any_of(pair.corner.begin(), pair.corner.end(), [&](std::int32_t s) {
      return !numbering.is_inside(number, patch.vertex[s]);
    });
  };
  const auto inner = std::stable_partition(patch.pairs.begin(), patch.pairs.end(), is_outer);
  // whole blocks, whose lanes are ordered together
  patch.outer = std::min((inner - patch.pairs.begin() + lanes - 1) / lanes * lanes, patch.outer);
  std::vector<Pair> rest(patch.pairs.begin() + patch.outer, patch.pairs.end());
  patch.pairs.resize(patch.outer);
  reduce_bank_conflicts(patch.pairs);
  reduce_bank_conflicts(rest);
  patch.pairs.insert(patch.pairs.end(), rest.begin(), rest.end());
}

// `number` [vertices] is -1 before and after the call.
MeshPatch make_patch(const Mesh& mesh, int index, std::vector<std::int32_t>& number) {
  const std::span<const std::int32_t> tets = mesh.partition.patch(index);
  MeshPatch patch;
  std::vector<Corners> corners(tets.size());
  for (std::size_t t = 0; t < tets.size(); ++t) {
    for (int k = 0; k < 4; ++k) {
      const std::int64_t v = mesh.tets[4 * std::int64_t(tets[t]) + k];
      if (number[v] < 0) {
        number[v] = std::int32_t(patch.vertex.size());
        patch.vertex.push_back(std::int32_t(v));
      }
      corners[t][k] = number[v];
    }
  }
  for (const std::int32_t v : patch.vertex) number[v] = -1;

  patch.pairs = pair_tets(corners);
  patch.forces.assign(patch.vertex.size(), 0);
  for (const Pair& pair : patch.pairs) {
    for (int c = 0; c < pair.corners(); ++c) ++patch.forces[pair.corner[c]];
  }
  const std::vector<std::int32_t> slot = slots_of(patch, index, mesh.numbering);
  scatter(patch.vertex, slot);
  scatter(patch.forces, slot);
  for (Pair& pair : patch.pairs) {
    for (std::int32_t& corner : pair.corner) corner = slot[corner];
    for (std::int32_t& tet : pair.tet) tet = tet < 0 ? -1 : tets[tet];
  }
  order_pairs(patch, index, mesh.numbering);
  patch.piped = mesh.kernel == stream_kernel && std::ssize(patch.vertex) <= pipeline_slots;
  count_entries(patch);
  return patch;
}

}  // namespace

std::vector<MeshPatch> make_patches(const Mesh& mesh, std::int64_t vertices) {
  const Partition& partition = mesh.partition;
  std::int64_t most_tets = 0;
  for (int p = 0; p < partition.patches(); ++p)
    most_tets = std::max(most_tets, std::ssize(partition.patch(p)));
  // two tetrahedra have at least five entries
  if (5 * most_tets / 2 >= none)
    refuse(partition.patches(), 5 * most_tets / 2, "entries", none - 1);
  std::vector<MeshPatch> patches(partition.patches());
  run_team(most_threads(), [&](const Team& team) {
    std::vector<std::int32_t> number(vertices, -1);
    for (std::int64_t p = team.begin(std::ssize(patches)); p < team.end(std::ssize(patches)); ++p)
      patches[p] = make_patch(mesh, int(p), number);
  });
  for (const MeshPatch& patch : patches) {
    if (patch.entries >= none) refuse(partition.patches(), patch.entries, "entries", none - 1);
    if (std::ssize(patch.vertex) > most_slots)
      refuse(partition.patches(), std::ssize(patch.vertex), "slots", most_slots);
  }
  return patches;
}

}  // namespace pd
