#include "plan/gpu/build.h"

#include "plan/gpu/bank_conflicts.h"
#include "plan/gpu/ownership.h"
#include "plan/gpu/patch.h"
#include "plan/gpu/rows.h"
#include "plan/gpu/stencil_blocks.h"
#include "plan/mesh/rest_shape.h"
#include "threads/team.h"
#include "views/shared_memory.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>

namespace pd {

namespace {

constexpr int most_part = 128;     // vertices, which a warp sums
constexpr int most_children = 32;  // rows of a sum over a piece

// Computes the offsets of each patch's arrays.
void number_patches(DeviceMeshPlan& plan, const std::vector<MeshPatch>& patches, int members,
                    bool computed, bool fixed) {
  plan.patch_block = plan.patch_slot = {0};
  for (const MeshPatch& patch : patches) {
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
  if (members == 4) plan.pair_coupled.resize(blocks * lanes);
  if (!computed || patches.size() == 1) plan.pair_rest.resize(blocks * pair_rest_numbers * lanes);
  if (computed && !fixed) plan.slot_rest.resize(slots * 4);
  plan.pair_corner.resize(blocks * 5 * lanes);
  plan.slot_vertex.resize(slots);
  plan.slot_row.resize(slots);
  if (!computed) return;
  plan.pair_factor.resize(blocks * 2 * lanes);
  plan.patch_unit.assign(patches.size(), 1.0);
  if (fixed) plan.slot_fixed.resize(slots * 4);
}

std::int32_t packed(std::int64_t low, std::int64_t high) {
  return std::int32_t(std::uint32_t(low) | std::uint32_t(high) << 16);
}

// The tetrahedra of a block of pairs: the first of each pair, then the second.
struct BlockTets {
  std::array<RestShape, 2 * lanes> shape;
  std::array<bool, 2 * lanes> traceless;
};

// Writes rest shapes of a pair in lane `lane` of `block`.
void fill_rest(DeviceMeshPlan& plan, const Mesh& mesh, const MeshPatch& patch, const Pair& pair,
               double unit, std::int64_t block, std::int64_t lane, BlockTets& tets) {
  std::array<std::int64_t, 5> vertex;
  for (int c = 0; c < 5; ++c) vertex[c] = patch.vertex[pair.corner[c]];
  double volume[2];
  for (int which = 0; which < 2; ++which) {
    const std::int64_t place = which * lanes + lane;
    const RestShape rest =
        rest_shape(mesh.elements.positions, {vertex[0], vertex[1], vertex[2], vertex[3 + which]});
    tets.shape[place] = rest;
    tets.traceless[place] =
        pair.tet[which] >= 0 && !mesh.elements.averaged.has_trace(pair.tet[which]);
    if (!plan.pair_factor.empty())
      plan.pair_factor[2 * block * lanes + place] = unit * unit / (6 * rest.volume);
    volume[which] = pair.tet[which] < 0 ? 0 : std::abs(rest.volume);
  }
  if (plan.pair_rest.empty()) return;
  const std::array<double, 9> face = face_rest(mesh.elements.positions, vertex);
  const double fourth[3] = {0, volume[0], volume[1]};
  for (int quad = 0; quad < 3; ++quad) {
    double* to = &plan.pair_rest[((block * 3 + quad) * lanes + lane) * 4];
    std::copy_n(&face[3 * quad], 3, to);
    to[3] = fourth[quad];
  }
}

void fill_bounds(DeviceMeshPlan& plan, std::int64_t block, const BlockTets& tets) {
  for (std::size_t first = 0; first < tets.shape.size(); first += bound_lanes) {
    std::array<RestShape, bound_lanes> shapes;
    std::copy_n(tets.shape.begin() + first, bound_lanes, shapes.begin());
    const std::array<double, bound_lanes> bounds = tet_bounds(shapes);
    for (std::size_t i = 0; i < bound_lanes; ++i)
      plan.pair_bound[2 * block * lanes + first + i] =
          tets.traceless[first + i] ? -bounds[i] : bounds[i];
  }
}

void fill_blocks(DeviceMeshPlan& plan, const Mesh& mesh, const MeshPatch& patch, int number,
                 double unit, EntryChoice& choice) {
  const std::int64_t first_block = plan.patch_block[number];
  const std::int64_t count = std::ssize(patch.pairs);
  BlockTets tets;
  for (std::int64_t i = 0; i < patch.blocks() * lanes; ++i) {
    const std::int64_t block = first_block + i / lanes, lane = i % lanes;
    Pair pair = patch.pairs[std::min(i, count - 1)];
    int forces = pair.corners();
    if (i >= count) {  // padding repeats the last pair, with zero weight and no force
      pair.tet = {-1, -1};
      forces = 0;
    }
    fill_rest(plan, mesh, patch, pair, unit, block, lane, tets);
    if (lane == lanes - 1) fill_bounds(plan, block, tets);
    if (!plan.pair_coupled.empty()) plan.pair_coupled[block * lanes + lane] = i < patch.coupled;
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

// Renumbers interior vertices in the order of their slots.
void renumber(Numbering& numbering, const std::vector<MeshPatch>& patches) {
  for (std::size_t p = 0; p < patches.size(); ++p) {
    const std::int32_t inside = numbering.patch_vertex[p];
    for (std::int32_t s = 0; s < numbering.patch_vertex[p + 1] - inside; ++s) {
      numbering.vertex_order[inside + s] = patches[p].vertex[s];
      numbering.internal[patches[p].vertex[s]] = inside + s;
    }
  }
}

void fill_slots(DeviceMeshPlan& plan, const Mesh& mesh, const MeshPatch& patch, int number) {
  for (std::size_t s = 0; s < patch.vertex.size(); ++s) {
    const std::size_t slot = plan.patch_slot[number] + s;
    plan.slot_vertex[slot] = mesh.numbering.internal[patch.vertex[s]];
    plan.slot_row[slot] = packed(patch.first[s], patch.forces[s]);
  }
}

// Writes rest positions of a patch relative to its first vertex, in metres or in units of up to
// 2^-29 of its extent.
void fill_rest_positions(DeviceMeshPlan& plan, const Mesh& mesh, const MeshPatch& patch,
                         int number) {
  const auto offset = [&](std::size_t s, int c) {
    return mesh.elements.positions[3 * std::int64_t(patch.vertex[s]) + c] -
           mesh.elements.positions[3 * std::int64_t(patch.vertex[0]) + c];
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
  // up to 2^29 units, so that differences stay below 2^30
  const double unit = std::ldexp(1.0, exponent - 29);
  plan.patch_unit[number] = unit;
  for (std::size_t s = 0; s < count; ++s) {
    for (int c = 0; c < 3; ++c)
      plan.slot_fixed[first + 4 * s + c] = std::int32_t(std::llround(offset(s, c) / unit));
  }
}

// Cluster: lists the slots of each vertex in patches that do not own it.
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

// The first patch that holds a shared vertex owns it.
void mark_owners(DeviceMeshPlan& plan) {
  for (std::size_t i = 0; i + 1 < plan.shared_start.size(); ++i) {
    for (std::int32_t at = plan.shared_start[i] + 1; at < plan.shared_start[i + 1]; ++at)
      plan.slot_row[plan.shared_slot[at]] |= std::int32_t(0x80000000);
  }
}

// Lists the slots of each shared vertex, in rows of seven, for every shared slot.
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

// Orders the forces on shared vertices by vertex.
void place_forces(DeviceMeshPlan& plan) {
  const std::int32_t first_shared = plan.patch_vertex.back();
  std::vector<std::int32_t> next(plan.shared_start.begin(), plan.shared_start.end() - 1);
  plan.shared_place.reserve(plan.shared_slot.size());
  for (const std::int32_t v : plan.slot_vertex) {
    if (v >= first_shared) plan.shared_place.push_back(next[v - first_shared]++);
  }
}

// Lists the vertices of each free piece, patch by patch, in parts. Every vertex belongs to the first patch that holds it.
std::vector<std::int32_t> add_parts(DeviceMeshPlan& plan, const std::int32_t* piece) {
  plan.patch_part = plan.part_start = {0};
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
      if (i + 1 < mine.size() && mine[i + 1].first == mine[i].first && size < most_part) continue;
      plan.part_start.push_back(std::int32_t(plan.part_slot.size()));
      part_piece.push_back(mine[i].first);
    }
    plan.patch_part.push_back(std::int32_t(part_piece.size()));
  }
  return part_piece;
}

// The tree of sums over the parts of each piece: rows of parts, piece by piece in patch order, then those of sums of at most
// 32 rows, level by level.
void add_sums(DeviceMeshPlan& plan, const std::vector<std::int32_t>& part_piece,
              std::int32_t pieces) {
  std::vector<std::int32_t> start(pieces + 1, 0);
  for (const std::int32_t number : part_piece) ++start[number + 1];
  std::partial_sum(start.begin(), start.end(), start.begin());
  std::vector<std::int32_t> begin(start.begin(), start.end() - 1),
      next = begin, end(start.begin() + 1, start.end());
  for (const std::int32_t number : part_piece) plan.part_row.push_back(next[number]++);
  const auto is_wide = [&](std::int32_t p) { return end[p] - begin[p] > most_children; };
  std::int32_t rows = std::int32_t(part_piece.size());
  plan.level_sum = {0};
  for (bool wide = true; wide;) {
    wide = false;
    for (std::int32_t p = 0; p < pieces; ++p) {
      if (!is_wide(p)) continue;
      const std::int32_t first = rows;
      for (std::int32_t child = begin[p]; child < end[p]; child += most_children, ++rows)
        plan.sum_rows.insert(plan.sum_rows.end(), {child, std::min(child + most_children, end[p])});
      begin[p] = first;
      end[p] = rows;
      wide = true;
    }
    if (wide) plan.level_sum.push_back(std::int32_t(plan.sum_rows.size() / 2));
  }
  for (std::int32_t p = 0; p < pieces; ++p)
    plan.piece_rows.insert(plan.piece_rows.end(), {begin[p], end[p]});
}

// Replaces groups by their tetrahedra, which count before the stencils.
void expand_groups(Mesh& mesh, const MeshElements& elements) {
  const Partition groups = std::move(mesh.partition);
  mesh.partition = {{}, {0}};
  mesh.group.resize(elements.tet_count);
  for (int p = 0; p < groups.patches(); ++p) {
    for (const std::int32_t g : groups.patch(p)) {
      if (g >= elements.solids()) {
        mesh.partition.elements.push_back(std::int32_t(g - elements.solids() + elements.tet_count));
        continue;
      }
      for (int m = 0; m < elements.members(g); ++m) {
        mesh.partition.elements.push_back(elements.member(g, m));
        mesh.group[elements.member(g, m)] = g;
      }
    }
    mesh.partition.start.push_back(std::ssize(mesh.partition.elements));
  }
}

std::vector<std::int32_t> count_sizes(const DeviceMeshPlan& plan,
                                      const std::vector<MeshPatch>& patches, std::int64_t tets,
                                      std::int32_t pieces, int kernel) {
  std::vector<std::int32_t> sizes(size_count, 0);
  sizes[size_kernel] = kernel;
  sizes[size_vertices] = std::int32_t(plan.vertex_order.size());
  sizes[size_tets] = std::int32_t(tets);
  sizes[size_pieces] = pieces;
  sizes[size_blocks] = plan.patch_block.back();
  sizes[size_patches] = std::int32_t(patches.size());
  sizes[size_slots] = plan.patch_slot.back();
  sizes[size_shared] = std::int32_t(plan.shared_start.size() - 1);
  sizes[size_parts] = std::int32_t(plan.part_row.size());
  sizes[size_sums] = std::int32_t(plan.sum_rows.size() / 2);
  sizes[size_sum_levels] = pieces > 0 ? std::int32_t(plan.level_sum.size()) - 1 : 0;
  sizes[size_senders] = std::int32_t(plan.slot_sender.size() / 8);
  for (std::size_t p = 0; p < patches.size(); ++p) {
    const auto raise = [&](DeviceSize which, std::int64_t size) {
      sizes[which] = std::max(sizes[which], std::int32_t(size));
    };
    raise(size_most_slots, std::ssize(patches[p].vertex));
    raise(size_most_pairs, std::ssize(patches[p].pairs));
    raise(size_most_entries, patches[p].entries);
    raise(size_most_interior, plan.patch_vertex[p + 1] - plan.patch_vertex[p]);
  }
  return sizes;
}

}  // namespace

DeviceMeshPlan build_device_plan(const MeshElements& elements, int patches, int kernel, bool fixed,
                                 const std::int32_t* piece,
                                 const std::function<void(double)>& progress) {
  const std::int64_t vertices = elements.vertices;
  Mesh mesh{elements, {}, {}, {}, kernel};
  if (kernel == cluster_kernel) {
    Ownership owned =
        own_vertices(elements.positions, vertices, elements.tets, elements.tet_count, patches);
    mesh.partition = std::move(owned.mesh);
    mesh.owner = std::move(owned.owner);
    mesh.numbering = number_owned(mesh.owner, patches);
  } else {
    mesh.partition = partition_mesh(elements, patches, 1);
    mesh.numbering = number_vertices(mesh.partition, elements);
    if (elements.averaged.members > 1) expand_groups(mesh, elements);
  }
  progress(0.4);
  const std::vector<MeshPatch> made = make_patches(mesh, vertices);
  progress(0.7);

  DeviceMeshPlan plan;
  number_patches(plan, made, elements.averaged.members, kernel == stream_kernel, fixed);
  number_stencils(plan, elements, made);
  number_rows(plan, elements, made);
  renumber(mesh.numbering, made);
  plan.vertex_order = mesh.numbering.vertex_order;
  run_team(most_threads(), [&](const Team& team) {
    for (std::int64_t p = team.begin(patches); p < team.end(patches); ++p) {
      fill_slots(plan, mesh, made[p], int(p));
      const bool computed = kernel == stream_kernel;
      if (computed) fill_rest_positions(plan, mesh, made[p], int(p));
      EntryChoice choice(made[p].first, made[p].forces, made[p].piped);
      fill_blocks(plan, mesh, made[p], int(p), computed ? plan.patch_unit[p] : 1.0, choice);
      fill_stencils(plan, elements, made[p], int(p), choice);
      fill_rows(plan, elements, made[p], int(p));
    }
  });
  plan.patch_vertex = std::move(mesh.numbering.patch_vertex);
  SharedSlots shared =
      link_shared(plan.slot_vertex, plan.patch_vertex.back(), std::ssize(plan.vertex_order));
  plan.shared_start = std::move(shared.start);
  plan.shared_slot = std::move(shared.slot);
  mark_owners(plan);
  for (std::size_t s = 0; s < plan.step_row.size(); ++s)
    plan.step_row[s] |= plan.slot_row[s] & std::int32_t(0x80000000);
  if (kernel == grid_kernel) link_slots(plan);
  if (kernel == stream_kernel) place_forces(plan);
  if (kernel == cluster_kernel) link_copies(plan);
  const std::int32_t pieces = *std::max_element(piece, piece + vertices) + 1;
  if (pieces > 0) add_sums(plan, add_parts(plan, piece), pieces);
  plan.sizes = count_sizes(plan, made, elements.tet_count, pieces, kernel);
  const bool large = std::ranges::any_of(elements.groups, [](const auto& g) { return g.large; });
  if (large || !elements.averaged.is_empty()) plan.sizes[size_members] = elements.averaged.members;
  progress(1.0);
  return plan;
}

}  // namespace pd
