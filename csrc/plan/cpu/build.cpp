#include "plan/cpu/build.h"

#include "plan/mesh/partition.h"
#include "plan/mesh/rest_shape.h"
#include "plan/mesh/stencils.h"
#include "threads/team.h"

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>
#include <utility>

namespace pd {

namespace {

constexpr int lanes = 16;

// Slots of patch `number`: its interior vertices in their order, then the shared ones as they appear.
void add_slots(MeshPlan& plan, const Numbering& n, const MeshElements& elements,
               std::span<const std::int32_t> patch, std::int64_t number,
               std::vector<std::int32_t>& slot_of) {
  const std::int32_t begin = plan.patch_slot.back();
  for (std::int32_t v = n.patch_vertex[number]; v < n.patch_vertex[number + 1]; ++v) {
    slot_of[n.vertex_order[v]] = std::int32_t(plan.slot_vertex.size()) - begin;
    plan.slot_vertex.push_back(v);
  }
  for (const std::int32_t e : patch) {
    for (const std::int64_t v : elements.corners(e)) {
      if (!n.is_shared[v] || slot_of[v] >= 0) continue;
      slot_of[v] = std::int32_t(plan.slot_vertex.size()) - begin;
      plan.slot_vertex.push_back(n.internal[v]);
    }
  }
  plan.patch_slot.push_back(std::int32_t(plan.slot_vertex.size()));
  if (plan.slot_vertex.size() - begin > std::numeric_limits<std::int16_t>::max())
    throw std::invalid_argument(
        "a patch has more vertices than 16 bits count: give a smaller patch_size");
}

// One block of tetrahedra; `padding`: lanes that repeat another and count nothing.
void set_block(MeshPlan& plan, std::size_t block, const MeshElements& elements,
               const std::array<std::int32_t, lanes>& tets, const std::array<bool, lanes>& padding,
               const std::vector<std::int32_t>& slot_of) {
  const double* x = elements.positions;
  for (int first = 0; first < lanes; first += int(bound_lanes)) {
    std::array<RestShape, bound_lanes> shapes;
    for (int i = 0; i < int(bound_lanes); ++i)
      shapes[i] = rest_shape(x, elements.tet(tets[first + i]));
    const std::array<double, bound_lanes> bounds = tet_bounds(shapes);
    for (int i = 0; i < int(bound_lanes); ++i) {
      const int lane = first + i;
      const std::int32_t t = tets[lane];
      const std::array<std::int64_t, 4> corner = elements.tet(t);
      const auto face = face_rest<4>(x, corner);
      plan.tet_order[block * lanes + lane] = t;
      plan.tet_volume[block * lanes + lane] = padding[lane] ? 0 : shapes[i].volume;
      plan.tet_bound[block * lanes + lane] =
          elements.averaged.has_trace(t) ? bounds[i] : -bounds[i];
      for (int n = 0; n < 6; ++n) plan.tet_rest[(block * 6 + n) * lanes + lane] = face[n];
      for (int k = 0; k < 4; ++k)
        plan.tet_corner[(block * 4 + k) * lanes + lane] = std::int16_t(slot_of[corner[k]]);
    }
  }
}

// Blocks of tetrahedra of one patch: the members of a group have one lane of as many blocks. Neighbours go to different
// blocks, so that lanes of a block rarely add to the same vertex.
void add_blocks(MeshPlan& plan, const MeshElements& elements, std::span<const std::int32_t> patch,
                const std::vector<std::int32_t>& slot_of) {
  const std::int64_t count = std::ssize(patch), blocks = (count + lanes - 1) / lanes;
  for (std::int64_t b = 0; b < blocks; ++b) {
    for (int member = 0; member < elements.averaged.members; ++member) {
      const std::size_t block = plan.tet_order.size() / lanes;
      plan.tet_order.resize((block + 1) * lanes);
      plan.tet_volume.resize((block + 1) * lanes);
      plan.tet_bound.resize((block + 1) * lanes);
      plan.tet_rest.resize((block + 1) * 6 * lanes);
      plan.tet_corner.resize((block + 1) * 4 * lanes);
      std::array<std::int32_t, lanes> tets;
      std::array<bool, lanes> padding;
      for (int lane = 0; lane < lanes; ++lane) {
        const std::int64_t i = lane * blocks + b;
        const std::int32_t e = patch[std::min(i, count - 1)];
        const int last = elements.members(e) - 1;
        tets[lane] = elements.member(e, std::min(member, last));
        padding[lane] = i >= count || member > last;
      }
      set_block(plan, block, elements, tets, padding, slot_of);
    }
  }
  plan.patch_block.push_back(std::int32_t(plan.tet_order.size() / lanes));
}

// Blocks of one patch's stencils of one group; `patch`: numbers of elements, `first` that of the group's first.
void add_stencils(MeshPlan& plan, const StencilGroup& group, std::span<const std::int32_t> patch,
                  std::int64_t first, const std::vector<std::int32_t>& slot_of) {
  const std::int64_t count = std::ssize(patch), blocks = (count + lanes - 1) / lanes;
  const int stored = stored_gradient_numbers(group) + group.constants;
  for (std::int64_t b = 0; b < blocks; ++b) {
    const auto rows = [](const auto& array) { return std::int32_t(array.size() / lanes); };
    const std::size_t corner = plan.stencil_corner.size(), number = plan.stencil_stored.size();
    plan.stencil_block.insert(
        plan.stencil_block.end(),
        {group.kind, rows(plan.stencil_corner), rows(plan.stencil_stored), plan.stencil_numbers});
    plan.stencil_numbers += group.numbers;
    plan.stencil_corner.resize(corner + group.corners * lanes);
    plan.stencil_stored.resize(number + stored * lanes);
    for (int lane = 0; lane < lanes; ++lane) {
      const std::int64_t i = lane * blocks + b;
      const std::int64_t s = patch[std::min(i, count - 1)] - first;
      plan.stencil_order.push_back(std::int32_t(s));
      plan.stencil_row.push_back(std::int32_t(group.row ? group.row[s] : s));
      plan.stencil_measure.push_back(i < count ? group.measure[s] : 0);
      plan.stencil_bound.push_back(stencil_bound(group, s));
      for (int c = 0; c < group.corners; ++c) {
        plan.stencil_corner[corner + c * lanes + lane] =
            std::int16_t(slot_of[group.corner[s * group.corners + c]]);
      }
      const std::vector<double> gradients = stored_gradients(group, s);
      for (int n = 0; n < stored; ++n) {
        const int constant = n - int(gradients.size());
        plan.stencil_stored[number + n * lanes + lane] =
            constant < 0 ? gradients[n] : group.constant[s * group.constants + constant];
      }
    }
  }
}

// Splits a patch, whose elements ascend, at its groups.
void add_elements(MeshPlan& plan, const MeshElements& elements, std::span<const std::int32_t> patch,
                  const std::vector<std::int32_t>& slot_of) {
  const auto before = [&](std::int64_t end) {
    return std::size_t(std::lower_bound(patch.begin(), patch.end(), end) - patch.begin());
  };
  std::int64_t first = elements.solids();
  std::size_t begin = before(first);
  add_blocks(plan, elements, patch.first(begin), slot_of);
  for (const StencilGroup& group : elements.groups) {
    const std::size_t end = before(first + group.count);
    add_stencils(plan, group, patch.subspan(begin, end - begin), first, slot_of);
    first += group.count;
    begin = end;
  }
  plan.patch_stencil.push_back(std::int32_t(plan.stencil_block.size() / 4));
}

// Several patches, [first, end), as a plan of their own. `slot_of` [vertices] is -1 before and after the call.
MeshPlan make_part(const Partition& mesh, const Numbering& numbering, const MeshElements& elements,
                   std::int64_t first, std::int64_t end, std::vector<std::int32_t>& slot_of) {
  MeshPlan part;
  part.patch_block = part.patch_slot = part.patch_stencil = {0};
  for (std::int64_t p = first; p < end; ++p) {
    const std::int32_t before = part.patch_slot.back();
    add_slots(part, numbering, elements, mesh.patch(int(p)), p, slot_of);
    add_elements(part, elements, mesh.patch(int(p)), slot_of);
    for (std::int32_t s = before; s < part.patch_slot.back(); ++s)
      slot_of[numbering.vertex_order[part.slot_vertex[s]]] = -1;
  }
  return part;
}

// Appends the numbers of all parts.
template <class T>
void join(MeshPlan& plan, std::vector<MeshPlan>& parts, std::vector<T> MeshPlan::* numbers) {
  std::vector<std::size_t> first = {0};
  for (const MeshPlan& part : parts) first.push_back(first.back() + (part.*numbers).size());
  (plan.*numbers).resize(first.back());
  run_team(most_threads(), [&](const Team& team) {
    for (std::int64_t i = team.begin(std::ssize(parts)); i < team.end(std::ssize(parts)); ++i) {
      const std::vector<T> own = std::move(parts[i].*numbers);
      std::copy(own.begin(), own.end(), (plan.*numbers).begin() + std::ptrdiff_t(first[i]));
    }
  });
}

// Appends the starts of all parts, which count from 0 in each.
void join_starts(MeshPlan& plan, const std::vector<MeshPlan>& parts,
                 std::vector<std::int32_t> MeshPlan::* starts) {
  plan.*starts = {0};
  for (const MeshPlan& part : parts) {
    const std::int32_t before = (plan.*starts).back();
    for (std::size_t i = 1; i < (part.*starts).size(); ++i)
      (plan.*starts).push_back(before + (part.*starts)[i]);
  }
}

// The same for the rows in stencil_block.
void join_stencil_blocks(MeshPlan& plan, const std::vector<MeshPlan>& parts) {
  std::array<std::int32_t, 4> before{};
  for (const MeshPlan& part : parts) {
    for (std::size_t i = 0; i < part.stencil_block.size(); ++i)
      plan.stencil_block.push_back(before[i % 4] + part.stencil_block[i]);
    before[1] += std::int32_t(part.stencil_corner.size() / lanes);
    before[2] += std::int32_t(part.stencil_stored.size() / lanes);
    before[3] += part.stencil_numbers;
  }
  plan.stencil_numbers = before[3];
}

MeshPlan joined(std::vector<MeshPlan> parts) {
  MeshPlan plan;
  join_starts(plan, parts, &MeshPlan::patch_block);
  join_starts(plan, parts, &MeshPlan::patch_slot);
  join_starts(plan, parts, &MeshPlan::patch_stencil);
  join_stencil_blocks(plan, parts);
  for (const auto numbers : {&MeshPlan::tet_order, &MeshPlan::slot_vertex, &MeshPlan::stencil_order,
                             &MeshPlan::stencil_row})
    join(plan, parts, numbers);
  for (const auto numbers :
       {&MeshPlan::tet_rest, &MeshPlan::tet_volume, &MeshPlan::tet_bound,
        &MeshPlan::stencil_measure, &MeshPlan::stencil_bound, &MeshPlan::stencil_stored})
    join(plan, parts, numbers);
  for (const auto numbers : {&MeshPlan::tet_corner, &MeshPlan::stencil_corner})
    join(plan, parts, numbers);
  return plan;
}

}  // namespace

MeshPlan build_plan(const MeshElements& elements, int patch_size,
                    const std::function<void(double)>& progress) {
  // tetrahedra and stencils
  const std::int64_t single = elements.tet_count + elements.count() - elements.solids();
  const Partition mesh = partition_mesh(elements, (single + patch_size - 1) / patch_size, lanes);
  progress(0.3);

  Numbering numbering = number_vertices(mesh, elements);
  constexpr std::int64_t together = 16;  // patches
  std::vector<MeshPlan> parts((mesh.patches() + together - 1) / together);
  run_team(most_threads(), [&](const Team& team) {
    std::vector<std::int32_t> slot_of(elements.vertices, -1);
    for (std::int64_t i = team.begin(std::ssize(parts)); i < team.end(std::ssize(parts)); ++i) {
      const std::int64_t end = std::min<std::int64_t>((i + 1) * together, mesh.patches());
      parts[i] = make_part(mesh, numbering, elements, i * together, end, slot_of);
    }
  });
  progress(0.8);
  MeshPlan plan = joined(std::move(parts));
  SharedSlots shared = link_shared(plan.slot_vertex, numbering.patch_vertex.back(),
                                   std::ssize(numbering.vertex_order));
  plan.shared_start = std::move(shared.start);
  plan.shared_slot = std::move(shared.slot);
  plan.vertex_order = std::move(numbering.vertex_order);
  plan.patch_vertex = std::move(numbering.patch_vertex);
  progress(1.0);
  return plan;
}

}  // namespace pd
