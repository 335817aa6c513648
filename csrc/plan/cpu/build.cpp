#include "plan/cpu/build.h"

#include "plan/mesh/partition.h"
#include "plan/mesh/rest_shape.h"

#include <algorithm>

namespace pd {

namespace {

constexpr int lanes = 16;

// Slots of one patch: its interior vertices in their order, then the shared ones as they appear.
void add_slots(MeshPlan& plan, const Numbering& n, const std::int64_t* tets,
               std::span<const std::int32_t> patch, std::vector<std::int32_t>& slot_of) {
  const std::int32_t begin = plan.patch_slot.back();
  const std::size_t number = plan.patch_slot.size() - 1;
  for (std::int32_t v = n.patch_vertex[number]; v < n.patch_vertex[number + 1]; ++v) {
    slot_of[n.vertex_order[v]] = std::int32_t(plan.slot_vertex.size()) - begin;
    plan.slot_vertex.push_back(v);
  }
  for (const std::int32_t t : patch) {
    for (int k = 0; k < 4; ++k) {
      const std::int64_t v = tets[4 * std::int64_t(t) + k];
      if (!n.is_shared[v] || slot_of[v] >= 0) continue;
      slot_of[v] = std::int32_t(plan.slot_vertex.size()) - begin;
      plan.slot_vertex.push_back(n.internal[v]);
    }
  }
  plan.patch_slot.push_back(std::int32_t(plan.slot_vertex.size()));
}

// Blocks of one patch. Neighbours go to different blocks, so that lanes of a block rarely add to the same vertex.
void add_blocks(MeshPlan& plan, const double* x, const std::int64_t* tets,
                std::span<const std::int32_t> patch, const std::vector<std::int32_t>& slot_of) {
  const std::int64_t count = std::ssize(patch), blocks = (count + lanes - 1) / lanes;
  for (std::int64_t b = 0; b < blocks; ++b) {
    const std::size_t block = plan.tet_order.size() / lanes;
    plan.tet_order.resize((block + 1) * lanes);
    plan.tet_volume.resize((block + 1) * lanes);
    plan.tet_bound.resize((block + 1) * lanes);
    plan.tet_rest.resize((block + 1) * 6 * lanes);
    plan.tet_corner.resize((block + 1) * 4 * lanes);
    for (int lane = 0; lane < lanes; ++lane) {
      const std::int64_t i = lane * blocks + b;
      const std::int32_t t = patch[std::min(i, count - 1)];
      const std::int64_t* corner = tets + 4 * std::int64_t(t);
      const Rest rest = rest_of(x, {corner[0], corner[1], corner[2], corner[3]});
      const auto face = face_rest<4>(x, {corner[0], corner[1], corner[2], corner[3]});
      plan.tet_order[block * lanes + lane] = t;
      plan.tet_volume[block * lanes + lane] = i < count ? rest.volume : 0;
      plan.tet_bound[block * lanes + lane] = rest.bound;
      for (int n = 0; n < 6; ++n) plan.tet_rest[(block * 6 + n) * lanes + lane] = face[n];
      for (int k = 0; k < 4; ++k) {
        plan.tet_corner[(block * 4 + k) * lanes + lane] = std::int16_t(slot_of[corner[k]]);
      }
    }
  }
  plan.patch_block.push_back(std::int32_t(plan.tet_order.size() / lanes));
}

}  // namespace

MeshPlan build_plan(const double* positions, std::int64_t vertices, const std::int64_t* tets,
                    std::int64_t count, int patch_size,
                    const std::function<void(double)>& progress) {
  const Partition mesh =
      partition_mesh(positions, tets, count, (count + patch_size - 1) / patch_size, lanes);
  progress(0.3);

  Numbering numbering = number_vertices(mesh, tets, vertices);
  MeshPlan plan;
  plan.patch_block.push_back(0);
  plan.patch_slot.push_back(0);
  std::vector<std::int32_t> slot_of(vertices, -1);
  for (int p = 0; p < mesh.patches(); ++p) {
    add_slots(plan, numbering, tets, mesh.patch(p), slot_of);
    add_blocks(plan, positions, tets, mesh.patch(p), slot_of);
    for (std::int32_t s = plan.patch_slot[p]; s < plan.patch_slot[p + 1]; ++s) {
      slot_of[numbering.vertex_order[plan.slot_vertex[s]]] = -1;
    }
    if (p % 64 == 0) progress(0.3 + 0.7 * double(p) / mesh.patches());
  }
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
