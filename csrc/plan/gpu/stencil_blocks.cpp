#include "plan/gpu/stencil_blocks.h"

#include "plan/mesh/stencils.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace pd {

namespace {

int stored_of(const StencilGroup& group) {
  return stored_gradient_numbers(group) + group.constants;
}

// Writes stencil `s` of a group to a lane of a block. Padding has no entries and no measure.
void fill_lane(DeviceMeshPlan& plan, const StencilGroup& group, std::int64_t s,
               const std::int32_t* slot, std::int64_t block, int lane, bool padding,
               EntryChoice& choice) {
  const std::int32_t* row = &plan.stencil_block[4 * block];
  plan.stencil_order[block * lanes + lane] = std::int32_t(s);
  plan.stencil_row[block * lanes + lane] = std::int32_t(group.row ? group.row[s] : s);
  plan.stencil_measure[block * lanes + lane] = padding ? 0 : group.measure[s];
  plan.stencil_bound[block * lanes + lane] = stencil_bound(group, s);
  for (int c = 0; c < group.corners; ++c) {
    const std::uint32_t entry = padding ? std::uint32_t(none) : choice.take(c, lane, slot[c]);
    plan.stencil_corner[(std::int64_t(row[1]) + c) * lanes + lane] =
        std::int32_t(std::uint32_t(slot_step * slot[c]) | entry << 16);
  }
  double* stored = &plan.stencil_stored[std::int64_t(row[2]) * lanes + lane];
  for (const double number : stored_gradients(group, s)) {
    *stored = number;
    stored += lanes;
  }
  for (int c = 0; c < group.constants; ++c)
    stored[std::int64_t(c) * lanes] = group.constant[s * group.constants + c];
}

}  // namespace

void number_stencils(DeviceMeshPlan& plan, const MeshElements& elements,
                     const std::vector<MeshPatch>& patches) {
  if (elements.groups.empty()) return;
  std::int32_t corners = 0, stored = 0, numbers = 0;
  plan.patch_stencil = {0};
  for (const MeshPatch& patch : patches) {
    for (const PatchStencils& own : patch.stencils) {
      const StencilGroup& group = elements.groups[own.group];
      for (std::int64_t b = 0; b < own.blocks(); ++b) {
        plan.stencil_block.insert(plan.stencil_block.end(), {group.kind, corners, stored, numbers});
        corners += group.corners;
        stored += stored_of(group);
        numbers += group.numbers;
      }
    }
    plan.patch_stencil.push_back(std::int32_t(plan.stencil_block.size() / 4));
  }
  const std::size_t blocks = plan.stencil_block.size() / 4;
  plan.stencil_order.resize(blocks * lanes);
  plan.stencil_row.resize(blocks * lanes);
  plan.stencil_measure.resize(blocks * lanes);
  plan.stencil_bound.resize(blocks * lanes);
  plan.stencil_corner.resize(std::size_t(corners) * lanes);
  plan.stencil_stored.resize(std::size_t(stored) * lanes);
  plan.stencil_sizes.assign(stencil_size_count, 0);
  plan.stencil_sizes[stencil_blocks] = std::int32_t(blocks);
  plan.stencil_sizes[stencil_corner_rows] = corners;
  plan.stencil_sizes[stencil_stored_rows] = stored;
  plan.stencil_sizes[stencil_number_rows] = numbers;
}

void fill_stencils(DeviceMeshPlan& plan, const MeshElements& elements, const MeshPatch& patch,
                   int number, EntryChoice& choice) {
  if (elements.groups.empty()) return;
  std::int64_t block = plan.patch_stencil[number];
  for (const PatchStencils& own : patch.stencils) {
    const StencilGroup& group = elements.groups[own.group];
    const std::int64_t count = std::ssize(own.number);
    for (std::int64_t i = 0; i < own.blocks() * lanes; ++i) {
      const std::int64_t from = std::min(i, count - 1);  // padding repeats the last
      fill_lane(plan, group, own.number[from], &own.corner[from * group.corners], block + i / lanes,
                int(i % lanes), i >= count, choice);
    }
    block += own.blocks();
  }
}

}  // namespace pd
