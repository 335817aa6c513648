// Tensors to views: the arrays of a plan, and their lengths.
#pragma once
#include "binding/checks.h"
#include "elements/kinds.h"
#include "views/shared_memory.h"
#include "views/views.h"

#include <ATen/ATen.h>
#include <c10/util/Exception.h>

#include <cstdint>
#include <string>
#include <string_view>

namespace pd {

template <class T>
constexpr at::ScalarType scalar_type = sizeof(T) == 4 ? at::kFloat : at::kDouble;
template <>
constexpr at::ScalarType scalar_type<int32> = at::kInt;
template <>
constexpr at::ScalarType scalar_type<int16> = at::kShort;

#define X(name, type, width, rows, meaning) +1
constexpr int plan_arrays = 0
#include "views/cpu_plan.def"
    ;
#undef X

// The counts of a plan. They stay on the CPU, so that no op waits for another device.
inline const int32* sizes_view(const Tensor& t, std::int64_t count) {
  check_array(t, at::kInt, count, 1, {at::kCPU, "every plan's sizes"}, "plan.sizes", "counts");
  return t.const_data_ptr<int32>();
}

// Lengths of the arrays, by the names in cpu_plan.def.
struct PlanRows {
  std::int64_t size, vertex, pin, block, patch_end, slot, shared_end, shared_slot;
};

#define X(name, type, width, rows, meaning) +1
constexpr int level_arrays = 0
#include "views/multilevel.def"
    ;
#undef X

// Lengths of the arrays, by the names in multilevel.def.
struct LevelRows {
  std::int64_t level_size, element, vertex, piece_pack, piece_pair_end, piece_row_task, piece_row,
      piece_tet_task, piece_tet, fine_end, fine_entry, fine_prolongation, host_fine_prolongation,
      device_fine_prolongation, fine_node_end, middle_end, middle_entry, middle,
      middle_prolongation, host_middle_prolongation, device_middle_prolongation, middle_node_end,
      coarse_entry, device_coarse_entry;
};

#define X(name, type, width, rows, meaning) +1
constexpr int stencil_arrays = 0
#include "views/cpu_stencils.def"
    ;
#undef X
static_assert(stencil_arrays != level_arrays);  // the number of arrays tells what follows

// The place of row_sizes in the tables.
#define X(name, type, width, rows, meaning) +1
constexpr int row_sizes_array = 0
#include "views/gpu_stencils.def"
    ;
#undef X

#define X(name, type, width, rows, meaning) +1
constexpr int device_stencil_arrays = 0
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
    ;
#undef X
static_assert(device_stencil_arrays != level_arrays);

// Lengths of the arrays, by the names in cpu_stencils.def, gpu_stencils.def and gpu_step_rows.def.
struct StencilRows {
  std::int64_t stencil_size, stencil_block, patch_end, stencil_corner_row, stencil_stored_row;
  std::int64_t row_size = 0, row_patch = 0, row_patch_end = 0, row_block_end = 0, row_block = 0,
               row = 0, term_end = 0, term = 0, row_slot = 0, row_pair = 0, row_corner_row = 0;
};

// The counts of the stencils, of every kind too.
inline StencilRows count_stencils(const Tensor& sizes, int patches) {
  constexpr int count = stencil_size_count + int(KindNumber::count);
  check_array(sizes, at::kInt, count, 1, {at::kCPU, "every plan's sizes"}, "plan.stencil_sizes",
              "counts");
  const int32* size = sizes.const_data_ptr<int32>();
  return {count, size[stencil_blocks], patches + 1, size[stencil_corner_rows],
          size[stencil_stored_rows]};
}

// The arrays of the stencils, which begin at `first`.
template <class T>
void view_stencils(Plan<T>& plan, at::TensorList arrays, int first, const Place& place) {
  const StencilRows count = count_stencils(arrays[first], plan.patches);
  const int32* size = arrays[first].const_data_ptr<int32>();
  plan.stencil_blocks = size[stencil_blocks];
  plan.stencil_numbers = size[stencil_number_rows];
  plan.remembers =
      any_kind(size + stencil_size_count, [](auto kind) { return memory_of<decltype(kind)> > 0; });
  int at = first;
  using real = T;
#define X(name, type, width, rows, meaning)                                                     \
  check_array(arrays[at], scalar_type<type>, count.rows, width, place, "plan." #name, meaning); \
  plan.name = arrays[at++].const_data_ptr<type>();
#include "views/cpu_stencils.def"
#undef X
}

// The preconditioner's arrays, which begin at `first`.
template <class T>
Levels<T> levels_view(at::TensorList arrays, int first, int vertices, std::int64_t elements,
                      const Place& place) {
  check_array(arrays[first], at::kInt, level_size_count, 1, {at::kCPU, "every plan's sizes"},
              "plan.level_sizes", "counts");
  const int32* size = arrays[first].const_data_ptr<int32>();
  Levels<T> levels = count_levels<T>(size, vertices);
  const bool middle = levels.has_middle();
  const std::int64_t coarse = levels.coarse_unknowns();
  LevelRows count{};
  count.level_size = level_size_count;
  count.element = elements;
  count.vertex = vertices;
  count.fine_end = vertices + 1;
  count.fine_entry = size[level_fine_entries];
  count.fine_prolongation = size[level_fine_prolongations];
  count.fine_node_end = levels.fine_nodes + 1;
  count.middle_end = middle ? levels.fine_nodes + 1 : 0;
  count.middle_entry = size[level_middle_entries];
  count.middle = middle ? levels.fine_nodes : 0;
  count.middle_prolongation = size[level_middle_prolongations];
  count.middle_node_end = middle ? levels.middle_nodes + 1 : 0;
  count.coarse_entry = coarse * (coarse + 1) / 2;
  count.piece_pack = levels.piece_packs;
  count.piece_row_task = levels.piece_row_tasks;
  count.piece_row = size[level_piece_rows];
  count.piece_tet_task = levels.piece_tet_tasks;
  count.piece_tet = size[level_piece_tets];
  const bool on_device = place.device.is_cuda();
  count.piece_pair_end = on_device ? levels.pieces * (levels.pieces + 1) / 2 + 1 : 0;
  (on_device ? count.device_fine_prolongation : count.host_fine_prolongation) =
      count.fine_prolongation;
  (on_device ? count.device_middle_prolongation : count.host_middle_prolongation) =
      count.middle_prolongation;
  count.device_coarse_entry = on_device ? count.coarse_entry : 0;
  const Place on_cpu{at::kCPU, "every plan's sizes"};
  int at = first;
  using real = T;
#define X(name, type, width, rows, meaning)                                                   \
  check_array(arrays[at], scalar_type<type>, count.rows, width, at == first ? on_cpu : place, \
              "plan." #name, meaning);                                                        \
  levels.name = arrays[at++].const_data_ptr<type>();
#include "views/multilevel.def"
#undef X
  return levels;
}

// Tetrahedra and stencils of a plan. `counts`: stencils of each kind; null without any.
inline std::int64_t count_elements(std::int64_t tets, const int32* counts) {
  std::int64_t elements = tets;
  for (int k = 0; counts && k < int(KindNumber::count); ++k) elements += counts[k];
  return elements;
}
template <class T>
const int32* stencil_counts(const Plan<T>& plan) {
  return plan.stencil_blocks > 0 ? plan.stencil_sizes + stencil_size_count : nullptr;
}

// Lengths of the arrays are checked; their contents are trusted.
template <class T>
Plan<T> plan_view(at::TensorList arrays, const Place& place) {
  const int others = int(arrays.size()) - plan_arrays;
  const bool stencils = others == stencil_arrays || others == stencil_arrays + level_arrays;
  const int levels_at = plan_arrays + (stencils ? stencil_arrays : 0);
  const bool levels = int(arrays.size()) == levels_at + level_arrays;
  TORCH_CHECK_VALUE(levels || int(arrays.size()) == levels_at, "plan must be the ", plan_arrays,
                    " arrays of Plan.arrays, ", stencil_arrays, " more with stencils, and ",
                    level_arrays, " more with a multilevel preconditioner, got ", arrays.size());
  const int32* size = sizes_view(arrays[0], plan_size_count);
  Plan<T> plan;
  plan.vertices = size[plan_vertices];
  plan.tets = size[plan_tets];
  plan.pins = size[plan_pins];
  plan.components = size[plan_components];
  plan.solid_components = size[plan_solid_components];
  plan.blocks = size[plan_blocks];
  plan.patches = size[plan_patches];
  plan.slots = size[plan_slots];
  plan.shared = size[plan_shared];
  plan.most_slots = size[plan_most_slots];
  plan.members = size[plan_members];
  TORCH_CHECK_VALUE(plan.patches >= 1 && plan.most_slots >= 1 && plan.most_slots <= plan.slots,
                    "plan.sizes must count at least one patch, and no more slots in one than in "
                    "all, got ",
                    plan.patches, " patches with up to ", plan.most_slots, " of ", plan.slots,
                    " slots; compile the scene again");
  PlanRows count{};
  count.size = plan_size_count;
  count.vertex = plan.vertices;
  count.pin = plan.pins;
  count.block = plan.blocks;
  count.patch_end = plan.patches + 1;
  count.slot = plan.slots;
  count.shared_end = plan.shared + 1;
  // every slot without an interior vertex of its patch holds a shared one
  count.shared_slot = plan.slots - (plan.vertices - plan.shared);
  int at = 0;
  using real = T;
#define X(name, type, width, rows, meaning)                                                     \
  check_array(arrays[at], scalar_type<type>, count.rows, width, place, "plan." #name, meaning); \
  plan.name = arrays[at++].const_data_ptr<type>();
#include "views/cpu_plan.def"
#undef X
  TORCH_CHECK_VALUE((plan.members == 1 || plan.members == 2 || plan.members == 4) &&
                        plan.blocks % plan.members == 0,
                    "plan.sizes must have groups of 1, 2 or 4 tetrahedra, and whole groups of "
                    "blocks, got ",
                    plan.members, " and ", plan.blocks, " blocks; compile the scene again");
  if (stencils) view_stencils(plan, arrays, plan_arrays, place);
  if (levels)
    plan.levels = levels_view<T>(arrays, levels_at, plan.vertices,
                                 int(count_elements(plan.tets, stencil_counts(plan))), place);
  return plan;
}

// A multilevel schedule needs the arrays of its preconditioner.
template <class P>
void check_levels(const P& plan, bool wanted) {
  TORCH_CHECK_VALUE(!wanted || plan.levels.there(),
                    "plan has no multilevel preconditioner; a Simulator with solver=Multilevel() "
                    "or Newton() makes one");
}

#define X(name, type, width, rows, meaning) +1
constexpr int device_plan_arrays = 0
#include "views/gpu_plan.def"
    ;
#undef X

// The place of part_slot in the table: the counts lack the number of free vertices.
#define X(name, type, width, rows, meaning) name,
enum class DevicePlanArray : int {
#include "views/gpu_plan.def"
};
#undef X
constexpr int part_slot_array = int(DevicePlanArray::part_slot);

// Lengths of the arrays, by the names in gpu_plan.def.
struct DevicePlanRows {
  std::int64_t size, vertex, pin, pinned_vertex, block, patch_end, patch, slot, shared_end,
      shared_slot, stream_slot, piece_slot, part_patch_end, part_end, part_slot, part, level_end,
      sum, piece, stored_block, rest_slot, fixed_slot, computed_block, computed_patch, sender,
      copied_vertex, coupled_block;
};

// Whether the arrays of the stencils follow those of the plan; a plan with levels has none.
inline bool has_device_stencils(at::TensorList arrays) {
  return arrays.size() == device_plan_arrays + device_stencil_arrays;
}

// Adds the lengths of the arrays of rows.
inline void count_rows(StencilRows& count, const Tensor& sizes, int patches) {
  check_array(sizes, at::kInt, row_size_count, 1, {at::kCPU, "every plan's sizes"},
              "plan.row_sizes", "counts");
  const int32* size = sizes.const_data_ptr<int32>();
  count.row_size = row_size_count;
  if (size[row_blocks] == 0) return;
  count.row_patch = patches;
  count.row_patch_end = patches + 1;
  count.row_block = size[row_blocks];
  count.row_block_end = count.row_block + 1;
  count.row = size[row_lines];
  count.term_end = std::int64_t(32) * (2 * count.row + count.row_block) + 1;
  count.term = size[row_terms];
  count.row_slot = size[row_slots];
  count.row_pair = size[row_pair_blocks];
  count.row_corner_row = size[row_corner_rows];
}

// The arrays of the stencils, without any if the plan has none.
template <class T>
DeviceStencils<T> device_stencils_view(at::TensorList arrays, int patches, const Place& place) {
  if (!has_device_stencils(arrays)) return {};
  const Tensor& row_sizes = arrays[device_plan_arrays + row_sizes_array];
  StencilRows count = count_stencils(arrays[device_plan_arrays], patches);
  count_rows(count, row_sizes, patches);
  DeviceStencils<T> stencils = count_device_stencils<T>(
      arrays[device_plan_arrays].const_data_ptr<int32>(), row_sizes.const_data_ptr<int32>());
  const int32* const counts =
      arrays[device_plan_arrays].const_data_ptr<int32>() + stencil_size_count;
  TORCH_CHECK_VALUE(!any_kind(counts, [](auto kind) { return !runs_on_gpu<decltype(kind)>; }),
                    "plan must have stencils that a GPU has kernels for, got some with a history; "
                    "step plastic solids on the CPU");
  const Place on_cpu{at::kCPU, "every plan's sizes"};
  int at = device_plan_arrays;
  using real = T;
#define X(name, type, width, rows, meaning)                                               \
  check_array(arrays[at], scalar_type<type>, count.rows, width,                           \
              std::string_view(#rows).ends_with("_size") ? on_cpu : place, "plan." #name, \
              meaning);                                                                   \
  stencils.name = arrays[at++].const_data_ptr<type>();
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
#undef X
  stencils.stencil_end = stencils.patch_stencil + 1;
  return stencils;
}

template <class T>
DevicePlan<T> device_plan_view(at::TensorList arrays, const Place& place) {
  constexpr int with_levels = device_plan_arrays + level_arrays;
  TORCH_CHECK_VALUE(arrays.size() == device_plan_arrays || arrays.size() == with_levels ||
                        has_device_stencils(arrays),
                    "plan must be the ", device_plan_arrays, " arrays of a plan for ",
                    place.device.str(), ", ", device_plan_arrays + device_stencil_arrays,
                    " with stencils, or ", with_levels,
                    " with those of a multilevel preconditioner, got ", arrays.size(),
                    "; sim.to(...) compiles the plan of a device");
  const int32* size = sizes_view(arrays[0], size_count);
  DevicePlan<T> plan = count_device_plan<T>(size);
  TORCH_CHECK_VALUE(plan.kernel >= 0 && plan.kernel <= 3 && plan.patches >= 1 &&
                        (plan.kernel != 0 || plan.patches == 1) && plan.most_slots >= 1 &&
                        plan.most_slots <= plan.slots && plan.most_entries >= 0,
                    "plan.sizes must name a kernel, 0 to 3, and at least one patch, one alone for "
                    "kernel 0, got kernel ",
                    plan.kernel, " and ", plan.patches, " patches; compile the scene again");
  constexpr int stream = 3;  // as in DeviceKernel, which this file does not include
  TORCH_CHECK_VALUE(!has_device_stencils(arrays) || plan.kernel == 0 || plan.kernel == stream,
                    "plan must be one for kernel 0 (block) or 3 (stream) where it has stencils, "
                    "got kernel ",
                    plan.kernel);
  TORCH_CHECK_VALUE(arrays.size() != with_levels || plan.kernel == stream,
                    "plan must be one for kernel 3 (stream) where it has a multilevel "
                    "preconditioner, which no other knows, got kernel ",
                    plan.kernel);
  TORCH_CHECK_VALUE((plan.members >= 0 && plan.members <= 2) || plan.members == 4,
                    "plan.sizes must have groups of 1, 2 or 4 tetrahedra, 0 without Poisson's "
                    "ratio, got ",
                    plan.members, "; compile the scene again");
  TORCH_CHECK_VALUE(plan.environments >= 0 && plan.environments <= most_environments,
                    "plan.sizes must have a multiprocessor work on 0 to ", most_environments,
                    " environments, got ", plan.environments, "; compile the scene again");
  TORCH_CHECK_VALUE(plan.blocks <= most_blocks, "plan.sizes must count up to ", most_blocks,
                    " blocks of 32 pairs of tetrahedra, whose corners 32 bits count, got ",
                    plan.blocks, "; compile the scene again, with fewer patches");
  // every slot without an interior vertex of its patch holds a shared one; in a cluster all are inside one patch.
  // Components and pins may be absent.
  const bool pieces = plan.pieces > 0, cluster = plan.kernel == 1;
  DevicePlanRows count{};
  count.size = size_count;
  count.vertex = plan.vertices;
  count.pin = plan.pins;
  count.pinned_vertex = plan.pins ? plan.vertices : 0;
  count.block = plan.blocks;
  count.patch = plan.patches;
  count.patch_end = plan.patches + 1;
  count.slot = plan.slots;
  count.shared_end = plan.shared + 1;
  count.shared_slot = cluster ? 0 : plan.slots - (plan.vertices - plan.shared);
  count.stream_slot = plan.kernel == stream ? count.shared_slot : 0;
  count.copied_vertex = cluster ? plan.vertices : 0;
  count.piece_slot = pieces ? plan.slots : 0;
  count.part_patch_end = pieces ? plan.patches + 1 : 0;
  count.part_end = pieces ? plan.parts + 1 : 0;
  count.part_slot = pieces ? arrays[part_slot_array].size(0) : 0;
  count.part = plan.parts;
  count.level_end = pieces ? plan.sum_levels + 1 : 0;
  count.sum = plan.sums;
  count.piece = plan.pieces;
  const bool computed = plan.kernel == stream, fixed = computed && sizeof(T) == 4;
  count.stored_block = computed && plan.patches > 1 ? 0 : plan.blocks;
  count.rest_slot = computed && !fixed ? plan.slots : 0;
  count.fixed_slot = fixed ? plan.slots : 0;
  count.computed_block = computed ? plan.blocks : 0;
  count.computed_patch = computed ? plan.patches : 0;
  count.sender = plan.senders;
  count.coupled_block = plan.members == 4 ? plan.blocks : 0;
  TORCH_CHECK_VALUE(plan.kernel != 2 || plan.senders >= count.shared_slot,
                    "plan.sizes must count a row of senders for each of the ", count.shared_slot,
                    " shared slots of kernel 2, got ", plan.senders, "; compile the scene again");
  const Place on_cpu{at::kCPU, "every plan's sizes"};
  int at = 0;
  using real = T;
#define X(name, type, width, rows, meaning)                                               \
  check_array(arrays[at], scalar_type<type>, count.rows, width, at == 0 ? on_cpu : place, \
              "plan." #name, meaning);                                                    \
  plan.name = arrays[at++].const_data_ptr<type>();
#include "views/gpu_plan.def"
#undef X
  if (arrays.size() == with_levels)
    plan.levels = levels_view<T>(arrays, device_plan_arrays, plan.vertices, plan.tets, place);
  return plan;
}

}  // namespace pd
