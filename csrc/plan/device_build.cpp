#include "plan/device_build.h"

#include "cpu/team.h"
#include "plan/ownership.h"
#include "plan/pairing.h"
#include "plan/partition.h"
#include "plan/phases.h"
#include "plan/rest.h"
#include "plan/shared_memory.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>

namespace pd {

namespace {

constexpr int lanes = 32, slice = entry_slice;
constexpr int small_pairs = 512;                          // of a patch
constexpr std::int64_t none = 65535;                      // entries of a patch count up to one less
constexpr std::int64_t slot_step = 8, most_slots = 8192;  // in pair_corner
// numbers of kernels, as DeviceKernel has them
constexpr int block_kernel = 0, cluster_kernel = 1, grid_kernel = 2, stream_kernel = 3;
constexpr int small_part = 64;  // vertices

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
struct Patch {
  std::vector<std::int32_t> vertex;  // user's vertex in each slot
  std::vector<std::int32_t> first;   // entry of each slot
  std::vector<std::int32_t> forces;  // corners of pairs that each slot adds up
  std::vector<Pair> pairs;           // user's tetrahedra, corners are slots
  std::int64_t outer = 0;            // pairs past which none touches a shared vertex
  std::int64_t entries = 0;
  bool piped = false;  // whether warps read and write entries as cuda/pipeline.h does

  std::int64_t blocks() const { return (std::ssize(pairs) + lanes - 1) / lanes; }
};

[[noreturn]] void refuse(int patches, std::int64_t count, const char* what, std::int64_t most) {
  throw std::invalid_argument("patches = " + std::to_string(patches) +
                              " is too few: one of them would have at least " +
                              std::to_string(count) + " " + what + ", and 16 bits count up to " +
                              std::to_string(most) + "; take more patches");
}

// Slots of a patch: interior vertices first, most forces first, which leaves little padding between entries. In a small patch,
// which has room for padding and waits for others most of the time, shared ones come as they are numbered: all their patches
// read and write them in runs then. Padding can grow to several times the forces where a few vertices have many.
std::vector<std::int32_t> slots_of(const Patch& patch, int number, const Numbering& numbering) {
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

// Every slice of eight slots has room for as many forces as its busiest.
void count_entries(Patch& patch) {
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

// As few as can be meet in a bank. In a patch that is not small those that touch shared vertices come in the first blocks.
void order_pairs(Patch& patch, int number, const Numbering& numbering) {
  patch.outer = std::ssize(patch.pairs);
  if (patch.outer <= small_pairs) return spread_banks(patch.pairs);
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
  spread_banks(patch.pairs);
  spread_banks(rest);
  patch.pairs.insert(patch.pairs.end(), rest.begin(), rest.end());
}

// `number` [vertices] is -1 before and after.
Patch make_patch(const Mesh& mesh, int index, std::vector<std::int32_t>& number) {
  const std::span<const std::int32_t> tets = mesh.partition.patch(index);
  Patch patch;
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

std::vector<Patch> make_patches(const Mesh& mesh, std::int64_t vertices) {
  const Partition& partition = mesh.partition;
  std::int64_t most_tets = 0;
  for (int p = 0; p < partition.patches(); ++p)
    most_tets = std::max(most_tets, std::ssize(partition.patch(p)));
  // five entries for two tetrahedra are the fewest
  if (5 * most_tets / 2 >= none)
    refuse(partition.patches(), 5 * most_tets / 2, "entries", none - 1);
  std::vector<Patch> patches(partition.patches());
  run_team(most_threads(), [&](const Team& team) {
    std::vector<std::int32_t> number(vertices, -1);
    for (std::int64_t p = team.begin(std::ssize(patches)); p < team.end(std::ssize(patches)); ++p)
      patches[p] = make_patch(mesh, int(p), number);
  });
  for (const Patch& patch : patches) {
    if (patch.entries >= none) refuse(partition.patches(), patch.entries, "entries", none - 1);
    if (std::ssize(patch.vertex) > most_slots)
      refuse(partition.patches(), std::ssize(patch.vertex), "slots", most_slots);
  }
  return patches;
}

// The numbers that say where the arrays of each patch begin.
void number_patches(DeviceMeshPlan& plan, const std::vector<Patch>& patches, bool stored,
                    bool fixed) {
  plan.patch_block = plan.patch_slot = {0};
  for (const Patch& patch : patches) {
    plan.patch_pairs.push_back(std::int32_t(patch.pairs.size()));
    plan.patch_outer.push_back(std::int32_t(patch.outer));
    plan.patch_block.push_back(plan.patch_block.back() + std::int32_t(patch.blocks()));
    plan.patch_slot.push_back(plan.patch_slot.back() + std::int32_t(patch.vertex.size()));
  }
  const std::size_t blocks = plan.patch_block.back(), slots = plan.patch_slot.back();
  if (std::int64_t(blocks) > most_blocks)
    throw std::overflow_error(
        "patches = " + std::to_string(patches.size()) + " is too many: they would have " +
        std::to_string(blocks) + " blocks of 32 pairs of tetrahedra, and 32 bits count up to " +
        std::to_string(most_blocks) + "; take fewer patches, or a coarser mesh");
  plan.pair_tet.resize(blocks * 2 * lanes);
  plan.pair_bound.resize(blocks * 2 * lanes);
  if (stored) plan.pair_rest.resize(blocks * pair_rest_numbers * lanes);
  if (!stored && !fixed) plan.slot_rest.resize(slots * 4);
  plan.pair_corner.resize(blocks * 5 * lanes);
  plan.slot_vertex.resize(slots);
  plan.slot_row.resize(slots);
  if (stored) return;
  plan.pair_factor.resize(blocks * 2 * lanes);
  plan.patch_unit.assign(patches.size(), 1.0);
  if (fixed) plan.slot_fixed.resize(slots * 4);
}

std::int32_t packed(std::int64_t low, std::int64_t high) {
  return std::int32_t(std::uint32_t(low) | std::uint32_t(high) << 16);
}

// Rest shapes and bounds of a pair in lane `lane` of `block`.
void fill_rest(DeviceMeshPlan& plan, const Mesh& mesh, const Patch& patch, const Pair& pair,
               double unit, std::int64_t block, std::int64_t lane) {
  std::array<std::int64_t, 5> vertex;
  for (int c = 0; c < 5; ++c) vertex[c] = patch.vertex[pair.corner[c]];
  double volume[2];
  for (int which = 0; which < 2; ++which) {
    const Rest rest = rest_of(mesh.positions, {vertex[0], vertex[1], vertex[2], vertex[3 + which]});
    plan.pair_bound[(2 * block + which) * lanes + lane] = rest.bound;
    if (!plan.pair_factor.empty())
      plan.pair_factor[(2 * block + which) * lanes + lane] = unit * unit / (6 * rest.volume);
    volume[which] = pair.tet[which] < 0 ? 0 : std::abs(rest.volume);
  }
  if (plan.pair_rest.empty()) return;
  const std::array<double, 9> face = face_rest(mesh.positions, vertex);
  const double fourth[3] = {0, volume[0], volume[1]};
  for (int quad = 0; quad < 3; ++quad) {
    double* to = &plan.pair_rest[((block * 3 + quad) * lanes + lane) * 4];
    std::copy_n(&face[3 * quad], 3, to);
    to[3] = fourth[quad];
  }
}

void fill_blocks(DeviceMeshPlan& plan, const Mesh& mesh, const Patch& patch, int number,
                 double unit) {
  const std::int64_t first_block = plan.patch_block[number];
  EntryChoice choice(patch.first, patch.forces, patch.piped);
  const std::int64_t count = std::ssize(patch.pairs);
  for (std::int64_t i = 0; i < patch.blocks() * lanes; ++i) {
    const std::int64_t block = first_block + i / lanes, lane = i % lanes;
    Pair pair = patch.pairs[std::min(i, count - 1)];
    int forces = pair.corners();
    if (i >= count) {  // padding strains like the last pair, but weighs nothing and pulls nowhere
      pair.tet = {-1, -1};
      forces = 0;
    }
    fill_rest(plan, mesh, patch, pair, unit, block, lane);
    for (int which = 0; which < 2; ++which) {
      const std::int32_t tet = pair.tet[which];
      const bool copy = tet >= 0 && !mesh.owner.empty() && mesh.counted_by(tet) != number;
      plan.pair_tet[(2 * block + which) * lanes + lane] = copy ? -2 - tet : tet;
    }
    for (int c = 0; c < 5; ++c) {
      const std::int32_t slot = pair.corner[c];
      plan.pair_corner[(5 * block + c) * lanes + lane] =
          packed(slot_step * slot, c < forces ? choice.take(c, int(lane), slot) : none);
    }
  }
}

// Interior vertices are numbered anew, in the order of their slots.
void renumber(Numbering& numbering, const std::vector<Patch>& patches) {
  for (std::size_t p = 0; p < patches.size(); ++p) {
    const std::int32_t inside = numbering.patch_vertex[p];
    for (std::int32_t s = 0; s < numbering.patch_vertex[p + 1] - inside; ++s) {
      numbering.vertex_order[inside + s] = patches[p].vertex[s];
      numbering.internal[patches[p].vertex[s]] = inside + s;
    }
  }
}

void fill_slots(DeviceMeshPlan& plan, const Mesh& mesh, const Patch& patch, int number) {
  for (std::size_t s = 0; s < patch.vertex.size(); ++s) {
    const std::size_t slot = plan.patch_slot[number] + s;
    plan.slot_vertex[slot] = mesh.numbering.internal[patch.vertex[s]];
    plan.slot_row[slot] = packed(patch.first[s], patch.forces[s]);
  }
}

// Rest positions of one patch from its first vertex, in metres or in units of which its extent has up to 2^29.
void fill_rest_positions(DeviceMeshPlan& plan, const Mesh& mesh, const Patch& patch, int number) {
  const auto offset = [&](std::size_t s, int c) {
    return mesh.positions[3 * std::int64_t(patch.vertex[s]) + c] -
           mesh.positions[3 * std::int64_t(patch.vertex[0]) + c];
  };
  const std::size_t count = patch.vertex.size(), first = 4 * std::size_t(plan.patch_slot[number]);
  if (!plan.slot_rest.empty()) {
    for (std::size_t s = 0; s < count; ++s) {
      for (int c = 0; c < 3; ++c) plan.slot_rest[first + 4 * s + c] = offset(s, c);
    }
  }
  if (plan.slot_fixed.empty()) return;
  double extent = 0;
  for (std::size_t s = 0; s < count; ++s) {
    for (int c = 0; c < 3; ++c) extent = std::max(extent, std::abs(offset(s, c)));
  }
  int exponent = 0;
  std::frexp(extent, &exponent);  // extent < 2^exponent
  // up to 2^29, so that differences are up to 2^30 and fit
  const double unit = std::ldexp(1.0, exponent - 29);
  plan.patch_unit[number] = unit;
  for (std::size_t s = 0; s < count; ++s) {
    for (int c = 0; c < 3; ++c)
      plan.slot_fixed[first + 4 * s + c] = std::int32_t(std::llround(offset(s, c) / unit));
  }
}

// Of a cluster: where each vertex has slots beside that of its owner.
void link_copies(DeviceMeshPlan& plan) {
  plan.slot_copy.assign(plan.vertex_order.size() * most_cluster_blocks, -1);
  std::vector<std::int32_t> found(plan.vertex_order.size(), 0);
  for (std::int32_t p = 0; p + 1 < std::int32_t(plan.patch_slot.size()); ++p) {
    const std::int32_t first = plan.patch_slot[p];
    const std::int32_t interior = plan.patch_vertex[p + 1] - plan.patch_vertex[p];
    for (std::int32_t slot = first + interior; slot < plan.patch_slot[p + 1]; ++slot) {
      const std::int32_t v = plan.slot_vertex[slot];
      plan.slot_copy[v * std::int64_t(most_cluster_blocks) + found[v]++] = packed(slot - first, p);
      plan.slot_row[slot] |= std::int32_t(0x80000000);
    }
  }
}

// The first patch that has a shared vertex owns it.
void mark_owners(DeviceMeshPlan& plan) {
  for (std::size_t i = 0; i + 1 < plan.shared_start.size(); ++i) {
    for (std::int32_t at = plan.shared_start[i] + 1; at < plan.shared_start[i + 1]; ++at)
      plan.slot_row[plan.shared_slot[at]] |= std::int32_t(0x80000000);
  }
}

// For every shared slot the slots of its vertex, in rows of seven.
void link_slots(DeviceMeshPlan& plan) {
  constexpr std::int32_t width = 8, together = width - 1;
  const std::int32_t first_shared = plan.patch_vertex.back();
  const std::size_t shared_slots = plan.shared_slot.size();
  plan.slot_sender.assign(shared_slots * width, -1);
  std::size_t number = 0;
  for (const std::int32_t v : plan.slot_vertex) {
    if (v < first_shared) continue;
    const std::int32_t* sender = plan.shared_slot.data() + plan.shared_start[v - first_shared];
    const std::int32_t* end = plan.shared_slot.data() + plan.shared_start[v - first_shared + 1];
    for (std::size_t row = number++ * width;; row = plan.slot_sender.size() - width) {
      for (int j = 0; j < together && sender < end; ++j) plan.slot_sender[row + j] = *sender++;
      plan.slot_sender[row + together] =
          sender < end ? std::int32_t(plan.slot_sender.size() / width) : 0;
      if (sender == end) break;
      plan.slot_sender.resize(plan.slot_sender.size() + width, -1);
    }
  }
}

// Forces on shared vertices lie vertex by vertex.
void place_forces(DeviceMeshPlan& plan) {
  const std::int32_t first_shared = plan.patch_vertex.back();
  std::vector<std::int32_t> next(plan.shared_start.begin(), plan.shared_start.end() - 1);
  plan.shared_place.reserve(plan.shared_slot.size());
  for (const std::int32_t v : plan.slot_vertex) {
    if (v >= first_shared) plan.shared_place.push_back(next[v - first_shared]++);
  }
}

// The vertices of each loose piece, patch by patch, in parts of `most` at most: every vertex in the first patch that has it.
void add_parts(DeviceMeshPlan& plan, const std::int32_t* piece, std::int32_t pieces, int most) {
  plan.patch_part = plan.part_start = {0};
  plan.piece_start.assign(pieces + 1, 0);
  std::vector<std::int32_t> part_piece;
  std::vector<std::pair<std::int32_t, std::int32_t>> mine;  // piece, slot
  for (std::size_t p = 0; p + 1 < plan.patch_slot.size(); ++p) {
    mine.clear();
    for (std::int32_t slot = plan.patch_slot[p]; slot < plan.patch_slot[p + 1]; ++slot) {
      const std::int32_t v = plan.slot_vertex[slot], number = piece[plan.vertex_order[v]];
      plan.slot_piece.push_back(number);
      if (number >= 0 && plan.slot_row[slot] >= 0) mine.emplace_back(number, slot);
    }
    std::sort(mine.begin(), mine.end());
    for (std::size_t i = 0; i < mine.size(); ++i) {
      plan.part_slot.push_back(mine[i].second);
      const std::int32_t size = std::int32_t(plan.part_slot.size()) - plan.part_start.back();
      if (i + 1 < mine.size() && mine[i + 1].first == mine[i].first && size < most) continue;
      plan.part_start.push_back(std::int32_t(plan.part_slot.size()));
      part_piece.push_back(mine[i].first);
    }
    plan.patch_part.push_back(std::int32_t(part_piece.size()));
  }
  for (const std::int32_t number : part_piece) ++plan.piece_start[number + 1];
  std::partial_sum(plan.piece_start.begin(), plan.piece_start.end(), plan.piece_start.begin());
  std::vector<std::int32_t> next(plan.piece_start.begin(), plan.piece_start.end() - 1);
  plan.piece_part.resize(part_piece.size());
  for (std::size_t part = 0; part < part_piece.size(); ++part)
    plan.piece_part[next[part_piece[part]]++] = std::int32_t(part);
}

std::vector<std::int32_t> count_sizes(const DeviceMeshPlan& plan, const std::vector<Patch>& patches,
                                      std::int64_t tets, std::int32_t pieces, int kernel) {
  std::vector<std::int32_t> sizes(size_count, 0);
  sizes[size_kernel] = kernel;
  sizes[size_vertices] = std::int32_t(plan.vertex_order.size());
  sizes[size_tets] = std::int32_t(tets);
  sizes[size_pieces] = pieces;
  sizes[size_blocks] = plan.patch_block.back();
  sizes[size_patches] = std::int32_t(patches.size());
  sizes[size_slots] = plan.patch_slot.back();
  sizes[size_shared] = std::int32_t(plan.shared_start.size() - 1);
  sizes[size_parts] = std::int32_t(plan.piece_part.size());
  sizes[size_senders] = std::int32_t(plan.slot_sender.size() / 8);
  for (std::size_t p = 0; p < patches.size(); ++p) {
    const auto raise = [&](DeviceSize which, std::int64_t size) {
      sizes[which] = std::max(sizes[which], std::int32_t(size));
    };
    const std::int64_t slots = std::ssize(patches[p].vertex);
    raise(size_most_slots, slots);
    raise(size_most_pairs, std::ssize(patches[p].pairs));
    raise(size_most_entries, patches[p].entries);
    const std::int64_t interior = plan.patch_vertex[p + 1] - plan.patch_vertex[p];
    raise(size_most_interior, interior);
    raise(size_most_shared, slots - interior);
    if (pieces > 0) raise(size_most_parts, plan.patch_part[p + 1] - plan.patch_part[p]);
  }
  return sizes;
}

}  // namespace

DeviceMeshPlan build_device_plan(const double* positions, std::int64_t vertices,
                                 const std::int64_t* tets, std::int64_t count, int patches,
                                 int kernel, bool fixed, const std::int32_t* piece,
                                 const std::function<void(double)>& progress) {
  Mesh mesh{positions, tets, {}, {}, {}, kernel};
  if (kernel == cluster_kernel) {
    Ownership owned = own_vertices(positions, vertices, tets, count, patches);
    mesh.partition = std::move(owned.mesh);
    mesh.owner = std::move(owned.owner);
    mesh.numbering = number_owned(mesh.owner, patches);
  } else {
    mesh.partition = partition_mesh(positions, tets, count, patches, 1);
    mesh.numbering = number_vertices(mesh.partition, tets, vertices);
  }
  progress(0.4);
  const std::vector<Patch> made = make_patches(mesh, vertices);
  progress(0.7);

  DeviceMeshPlan plan;
  number_patches(plan, made, kernel == block_kernel, fixed);
  renumber(mesh.numbering, made);
  plan.vertex_order = mesh.numbering.vertex_order;
  run_team(most_threads(), [&](const Team& team) {
    for (std::int64_t p = team.begin(patches); p < team.end(patches); ++p) {
      fill_slots(plan, mesh, made[p], int(p));
      const bool computed = kernel != block_kernel;
      if (computed) fill_rest_positions(plan, mesh, made[p], int(p));
      fill_blocks(plan, mesh, made[p], int(p), computed ? plan.patch_unit[p] : 1.0);
    }
  });
  plan.patch_vertex = std::move(mesh.numbering.patch_vertex);
  SharedSlots shared =
      link_shared(plan.slot_vertex, plan.patch_vertex.back(), std::ssize(plan.vertex_order));
  plan.shared_start = std::move(shared.start);
  plan.shared_slot = std::move(shared.slot);
  mark_owners(plan);
  if (kernel == grid_kernel) link_slots(plan);
  if (kernel == stream_kernel) place_forces(plan);
  if (kernel == cluster_kernel) link_copies(plan);
  const std::int32_t pieces = *std::max_element(piece, piece + vertices) + 1;
  // where few blocks hold an environment all their warps are to be busy
  const bool few = kernel == block_kernel || kernel == cluster_kernel;
  if (pieces > 0) add_parts(plan, piece, pieces, few ? small_part : int(vertices));
  plan.sizes = count_sizes(plan, made, count, pieces, kernel);
  progress(1.0);
  return plan;
}

}  // namespace pd
