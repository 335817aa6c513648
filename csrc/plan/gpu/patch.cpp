#include "plan/gpu/patch.h"

#include "plan/gpu/bank_conflicts.h"
#include "plan/gpu/rows.h"
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
constexpr int small_pairs = 512;  // of a patch, and stencils

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
  const bool small = patch.elements() <= small_pairs;
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

// Minimises bank conflicts. In a patch that is not small, pairs that touch shared vertices come in
// the first blocks.
void order_pairs(MeshPatch& patch, int number, const Numbering& numbering) {
  patch.outer = std::ssize(patch.pairs);
  if (patch.coupled > 0) return reduce_bank_conflicts(patch.pairs, patch.coupled);
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

// The stencils of a patch kind by kind; `elements` of the patch ascend from its first stencil on.
template <class Number>
void add_stencils(MeshPatch& patch, const MeshElements& all, std::span<const std::int32_t> elements,
                  const Number& local) {
  // MeshElements counts groups of tetrahedra
  const std::int64_t shift = all.solids() - all.tet_count;
  std::int64_t first = all.tet_count;
  auto next = elements.begin();
  for (std::size_t g = 0; g < all.groups.size(); first += all.groups[g++].count) {
    PatchStencils own;
    own.group = int(g);
    for (; next != elements.end() && *next < first + all.groups[g].count; ++next) {
      own.number.push_back(std::int32_t(*next - first));
      for (const std::int64_t v : all.corners(*next + shift)) own.corner.push_back(local(v));
    }
    if (!own.number.empty()) patch.stencils.push_back(std::move(own));
  }
  // a step takes the others as rows
  std::stable_partition(patch.stencils.begin(), patch.stencils.end(),
                        [&](const PatchStencils& own) { return !all.groups[own.group].quadratic; });
}

// `number` [vertices] is -1 before and after the call.
MeshPatch make_patch(const Mesh& mesh, int index, std::vector<std::int32_t>& number) {
  const std::span<const std::int32_t> elements = mesh.partition.patch(index);
  const auto end = std::lower_bound(elements.begin(), elements.end(), mesh.elements.tet_count);
  const auto tets = elements.first(std::size_t(end - elements.begin()));
  MeshPatch patch;
  const auto local = [&](std::int64_t v) {
    if (number[v] < 0) {
      number[v] = std::int32_t(patch.vertex.size());
      patch.vertex.push_back(std::int32_t(v));
    }
    return number[v];
  };
  std::vector<Corners> corners(tets.size());
  for (std::size_t t = 0; t < tets.size(); ++t) {
    for (int k = 0; k < 4; ++k)
      corners[t][k] = local(mesh.elements.tets[4 * std::int64_t(tets[t]) + k]);
  }
  add_stencils(patch, mesh.elements, elements.subspan(tets.size()), local);
  for (const std::int32_t v : patch.vertex) number[v] = -1;

  if (mesh.group.empty()) {
    patch.pairs = pair_tets(corners);
  } else {
    std::vector<int> sizes;
    for (std::size_t t = 0; t < tets.size(); ++t) {
      const bool begins = t == 0 || mesh.group[tets[t]] != mesh.group[tets[t - 1]];
      begins ? sizes.push_back(1) : void(++sizes.back());
    }
    patch.pairs = pair_groups(corners, sizes, patch.coupled);
  }
  patch.forces.assign(patch.vertex.size(), 0);
  for (const Pair& pair : patch.pairs) {
    for (int c = 0; c < pair.corners(); ++c) ++patch.forces[pair.corner[c]];
  }
  for (const PatchStencils& own : patch.stencils) {
    for (const std::int32_t corner : own.corner) ++patch.forces[corner];
  }
  const std::vector<std::int32_t> slot = slots_of(patch, index, mesh.numbering);
  scatter(patch.vertex, slot);
  scatter(patch.forces, slot);
  for (Pair& pair : patch.pairs) {
    for (std::int32_t& corner : pair.corner) corner = slot[corner];
    for (std::int32_t& tet : pair.tet) tet = tet < 0 ? -1 : tets[tet];
  }
  for (PatchStencils& own : patch.stencils) {
    for (std::int32_t& corner : own.corner) corner = slot[corner];
  }
  order_pairs(patch, index, mesh.numbering);
  // a single patch has the sums of kernel `block`, which may take its step (cuda/stream/contact_runner.cuh)
  patch.piped = mesh.kernel == stream_kernel && mesh.partition.patches() > 1 &&
                mesh.elements.groups.empty() && std::ssize(patch.vertex) <= pipeline_slots;
  patch.place(patch.piped);
  if (has_rows(mesh.elements)) make_rows(patch, mesh.elements);
  return patch;
}

}  // namespace

void Entries::place(bool piped) {
  first.resize(forces.size());
  SliceBanks banks;
  for (std::size_t s = 0; s < forces.size(); s += slice) {
    const std::size_t end = std::min(s + slice, forces.size());
    if (piped) entries = banks.next(entries);
    for (std::size_t i = s; i < end; ++i) first[i] = std::int32_t(entries + i - s);
    entries += slice * *std::max_element(forces.begin() + std::ptrdiff_t(s),
                                         forces.begin() + std::ptrdiff_t(end));
  }
}

std::vector<MeshPatch> make_patches(const Mesh& mesh, std::int64_t vertices) {
  const Partition& partition = mesh.partition;
  std::int64_t most_elements = 0;
  for (int p = 0; p < partition.patches(); ++p)
    most_elements = std::max(most_elements, std::ssize(partition.patch(p)));
  // two tetrahedra have at least five entries, and two stencils four
  const std::int64_t least = (mesh.elements.groups.empty() ? 5 : 4) * most_elements / 2;
  if (least >= none) refuse(partition.patches(), least, "entries", none - 1);
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
