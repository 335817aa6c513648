// Mesh work on NumPy arrays: plans for the CPU and for GPUs, and preconditioners.
#pragma once
#include "binding/tables.h"
#include "cuda/common/launch.h"
#include "elements/kinds.h"
#include "plan/cpu/build.h"
#include "plan/gpu/build.h"
#include "plan/multilevel/build.h"
#include "plan/multilevel/piece_lists.h"
#include "views/shared_memory.h"

#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

namespace pd::python {

using Doubles = py::array_t<double, py::array::c_style>;
using Numbers = py::array_t<std::int32_t, py::array::c_style>;
using Indices = py::array_t<std::int64_t, py::array::c_style>;

// Passes the numbers to NumPy without a copy.
template <class T>
py::array_t<T> as_array(std::vector<T>& numbers, py::ssize_t width) {
  auto* owned = new std::vector<T>(std::move(numbers));
  const py::capsule owner(owned, [](void* p) { delete static_cast<std::vector<T>*>(p); });
  const auto rows = py::ssize_t(owned->size()) / width;
  return py::array_t<T>(
      width > 1 ? std::vector<py::ssize_t>{rows, width} : std::vector<py::ssize_t>{rows},
      owned->data(), owner);
}

inline void check_mesh(const Doubles& positions, const Indices& tets, bool others = false) {
  if (positions.ndim() != 2 || positions.shape(1) != 3)
    throw py::value_error("positions must be float64 [vertices, 3]");
  if (tets.ndim() != 2 || tets.shape(1) != 4 || (tets.shape(0) == 0 && !others))
    throw py::value_error("tets must be int64 [count > 0, 4]");
  const std::int64_t count = positions.shape(0), *t = tets.data();
  // slots, up to four a tetrahedron, are counted in 32 bits
  constexpr std::int64_t most = std::int64_t(1) << 28;
  if (tets.shape(0) > most || count > most) {
    throw py::value_error("a mesh may have up to 2^28 = " + std::to_string(most) +
                          " vertices and tetrahedra, which 32 bits count, got " +
                          std::to_string(count) + " and " + std::to_string(tets.shape(0)) +
                          "; take a coarser mesh, or simulate its pieces one by one");
  }
  for (py::ssize_t i = 0; i < tets.size(); ++i) {
    if (t[i] < 0 || t[i] >= count)
      throw py::index_error("tets refer to vertices that positions does not have");
  }
}

// Stencils of one kind as Python gives them: kind, corners, g_a, V, constants, the tetrahedron of each if the kind
// reads its material, and whether their energy is quadratic.
using Stencils = std::tuple<int, Indices, Doubles, Doubles, Doubles, std::optional<Indices>, bool>;

inline void check_tets_of(const KindShape& shape, const std::optional<Indices>& row,
                          py::ssize_t count, std::int64_t tets) {
  if (row.has_value() != shape.of_tets)
    throw py::value_error(std::string(shape.name) + ": tetrahedra of stencils must be " +
                          (shape.of_tets ? "given" : "None"));
  if (!row) return;
  if (row->ndim() != 1 || row->shape(0) != count)
    throw py::value_error(std::string(shape.name) + ": tetrahedra of stencils must be [count]");
  for (py::ssize_t i = 0; i < count; ++i) {
    if (row->data()[i] < 0 || row->data()[i] >= tets)
      throw py::index_error(std::string(shape.name) +
                            ": stencils refer to tetrahedra that the mesh does not have");
  }
}

inline pd::StencilGroup stencil_group(const Stencils& given, std::int64_t vertices,
                                      std::int64_t tets) {
  const auto& [kind, corner, gradient, measure, constant, row, quadratic] = given;
  const std::vector<KindShape> shapes = kind_shapes();
  if (kind < 0 || kind >= std::ssize(shapes))
    throw py::value_error("the kind of stencils must be a row of kind_table");
  const KindShape& shape = shapes[kind];
  const py::ssize_t count = corner.ndim() == 2 ? corner.shape(0) : -1;
  const bool fits = count >= 0 && corner.shape(1) == shape.corners && gradient.ndim() == 3 &&
                    gradient.shape(0) == count && gradient.shape(1) == shape.corners &&
                    gradient.shape(2) == shape.dims && measure.ndim() == 1 &&
                    measure.shape(0) == count && constant.ndim() == 2 &&
                    constant.shape(0) == count && constant.shape(1) == shape.constants;
  if (!fits)
    throw py::value_error(std::string(shape.name) + ": corners must be int64 [count, " +
                          std::to_string(shape.corners) + "], gradients float64 [count, " +
                          std::to_string(shape.corners) + ", " + std::to_string(shape.dims) +
                          "], measure [count] and constants [count, " +
                          std::to_string(shape.constants) + "]");
  for (py::ssize_t i = 0; i < corner.size(); ++i) {
    if (corner.data()[i] < 0 || corner.data()[i] >= vertices)
      throw py::index_error(std::string(shape.name) +
                            ": corners refer to vertices that positions does not have");
  }
  check_tets_of(shape, row, count, tets);
  if (quadratic && shape.quadratic == 0)
    throw py::value_error(std::string(shape.name) + ": this kind has no quadratic energy");
  return {kind,
          shape.corners,
          shape.dims,
          shape.constants,
          shape.numbers,
          shape.keeps_axes,
          count,
          corner.data(),
          gradient.data(),
          measure.data(),
          constant.data(),
          row ? row->data() : nullptr,
          shape.large,
          quadratic};
}

// Checks the elements of a scene; the arrays stay the caller's.
inline pd::MeshElements mesh_elements(const Doubles& positions, const Indices& tets,
                                      const std::vector<Stencils>& stencils) {
  check_mesh(positions, tets, !stencils.empty());
  pd::MeshElements elements{positions.data(), positions.shape(0), tets.data(), tets.shape(0)};
  for (const Stencils& group : stencils)
    elements.groups.push_back(stencil_group(group, positions.shape(0), tets.shape(0)));
  constexpr std::int64_t most = std::int64_t(1) << 28;
  if (elements.count() > most)
    throw py::value_error("a scene may have up to 2^28 = " + std::to_string(most) +
                          " elements, whose corners 32 bits count, got " +
                          std::to_string(elements.count()) + "; take a coarser mesh");
  return elements;
}

// Adds the number of stencils of each kind, after the counts of StencilSize.
inline void add_kinds(std::vector<std::int32_t>& sizes, const pd::MeshElements& elements) {
  sizes.resize(pd::stencil_size_count + int(pd::KindNumber::count), 0);
  for (const pd::StencilGroup& group : elements.groups)
    sizes[pd::stencil_size_count + group.kind] = std::int32_t(group.count);
}

inline std::vector<std::int32_t> stencil_sizes(const pd::MeshPlan& plan,
                                               const pd::MeshElements& elements, int lanes) {
  std::vector<std::int32_t> sizes(pd::stencil_size_count);
  sizes[pd::stencil_blocks] = std::int32_t(plan.stencil_block.size() / 4);
  sizes[pd::stencil_corner_rows] = std::int32_t(plan.stencil_corner.size() / lanes);
  sizes[pd::stencil_stored_rows] = std::int32_t(plan.stencil_stored.size() / lanes);
  sizes[pd::stencil_number_rows] = plan.stencil_numbers;
  add_kinds(sizes, elements);
  return sizes;
}

// Groups of tetrahedra that average their trace, from the number of each tetrahedron's.
inline pd::TetGroups tet_groups(const std::optional<Indices>& group, const Indices& tets) {
  if (!group || tets.shape(0) == 0) return {};
  if (group->ndim() != 1 || group->shape(0) != tets.shape(0))
    throw py::value_error("tet_group must be int64 [tets], the number of each one's group");
  return pd::groups_of(group->data(), tets.data(), tets.shape(0));
}

inline py::dict build_plan(const Doubles& positions, const Indices& tets,
                           const std::vector<Stencils>& stencils,
                           const std::optional<Indices>& tet_group, int patch_size,
                           const std::function<void(double)>& progress) {
  pd::MeshElements elements = mesh_elements(positions, tets, stencils);
  elements.averaged = tet_groups(tet_group, tets);
  if (patch_size < 16 || patch_size > 8192)
    throw py::value_error("patch_size must lie in 16..8192");
  auto plan = pd::build_plan(elements, patch_size, progress);
  py::dict arrays;
  std::map<std::string, int> widths;
#define X(name, type, width, rows, meaning) widths[#name] = width;
#include "views/cpu_plan.def"
#include "views/cpu_stencils.def"
#undef X
  const auto add = [&](const char* name, auto& numbers) {
    arrays[name] = as_array(numbers, widths.at(name));
  };
  add("vertex_order", plan.vertex_order);
  add("tet_order", plan.tet_order);
  add("tet_rest", plan.tet_rest);
  add("tet_volume", plan.tet_volume);
  add("tet_bound", plan.tet_bound);
  add("tet_corner", plan.tet_corner);
  add("patch_block", plan.patch_block);
  add("patch_vertex", plan.patch_vertex);
  add("patch_slot", plan.patch_slot);
  add("slot_vertex", plan.slot_vertex);
  add("shared_start", plan.shared_start);
  add("shared_slot", plan.shared_slot);
  arrays["members"] = elements.averaged.members;
  if (stencils.empty()) return arrays;
  auto sizes = stencil_sizes(plan, elements, widths.at("stencil_order"));
  add("stencil_sizes", sizes);
  add("stencil_block", plan.stencil_block);
  add("patch_stencil", plan.patch_stencil);
  add("stencil_order", plan.stencil_order);
  add("stencil_row", plan.stencil_row);
  add("stencil_measure", plan.stencil_measure);
  add("stencil_bound", plan.stencil_bound);
  add("stencil_corner", plan.stencil_corner);
  add("stencil_stored", plan.stencil_stored);
  return arrays;
}

// A cluster's additional requirements: a vertex for every patch, and tetrahedra at every vertex.
inline void check_cluster(std::int64_t vertices, const Indices& tets, int patches) {
  const std::int64_t most = std::min<std::int64_t>(vertices, pd::most_cluster_blocks);
  if (patches > most)
    throw py::value_error("patches of kernel 1, a cluster, must lie in 1.." + std::to_string(most) +
                          ", got " + std::to_string(patches));
  std::vector<bool> used(vertices, false);
  for (py::ssize_t i = 0; i < tets.size(); ++i) used[tets.data()[i]] = true;
  const auto lone = std::find(used.begin(), used.end(), false);
  if (lone != used.end())
    throw py::value_error("vertex " + std::to_string(lone - used.begin()) +
                          " belongs to no tetrahedron, which kernel 1, a cluster, wants of all");
}

inline py::dict build_device_plan(const Doubles& positions, const Indices& tets,
                                  const std::vector<Stencils>& stencils, int patches, int kernel,
                                  bool fixed, const Numbers& piece,
                                  const std::function<void(double)>& progress,
                                  const std::optional<Indices>& tet_group) {
  pd::MeshElements elements = mesh_elements(positions, tets, stencils);
  elements.averaged = tet_groups(tet_group, tets);
  if (patches < 1 || patches > elements.count()) {
    throw py::value_error("patches must lie in 1.." + std::to_string(elements.count()) +
                          ", the number of elements, got " + std::to_string(patches));
  }
  if (kernel < 0 || kernel > 3)
    throw py::value_error("kernel must be 0, 1, 2 or 3, got " + std::to_string(kernel));
  if (!stencils.empty() && kernel != int(pd::DeviceKernel::block) &&
      kernel != int(pd::DeviceKernel::stream))
    throw py::value_error("kernel must be 0 (block) or 3 (stream) for a scene with stencils, got " +
                          std::to_string(kernel));
  const std::int64_t vertices = positions.shape(0);
  if (kernel == int(pd::DeviceKernel::cluster)) check_cluster(vertices, tets, patches);
  if (piece.ndim() != 1 || piece.shape(0) != vertices)
    throw py::value_error("piece must be int32 [vertices], a number for each row of positions");
  for (std::int64_t v = 0; v < vertices; ++v) {
    if (piece.at(v) < -1 || piece.at(v) >= vertices)
      throw py::value_error("piece must hold numbers of pieces, counted from 0, or -1");
  }
  auto plan = pd::build_device_plan(elements, patches, kernel, fixed, piece.data(), progress);
  py::dict arrays;
#define X(name, type, width, rows, meaning) arrays[#name] = as_array(plan.name, width);
#include "views/gpu_plan.def"
  if (stencils.empty()) return arrays;
  add_kinds(plan.stencil_sizes, elements);
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
#undef X
  return arrays;
}

inline py::dict build_multilevel(const Doubles& positions, const Indices& tets,
                                 const std::vector<Stencils>& stencils, const Numbers& order,
                                 const Doubles& stiffness, const Doubles& inertia,
                                 std::int64_t most_direct, bool folded, int threads,
                                 const std::function<void(double)>& progress) {
  const pd::MeshElements elements = mesh_elements(positions, tets, stencils);
  const py::ssize_t vertices = positions.shape(0);
  if (order.ndim() != 1 || order.shape(0) != vertices)
    throw py::value_error("vertex_order must be int32 [vertices], a permutation");
  if (stiffness.ndim() != 1 || stiffness.shape(0) != elements.count())
    throw py::value_error("stiffness must be float64 [elements]");
  if (inertia.ndim() != 1 || inertia.shape(0) != vertices)
    throw py::value_error("inertia must be float64 [vertices]");
  if (threads < 1) throw py::value_error("threads must be at least 1");
  auto tables = pd::build_multilevel(
      {elements, order.data(), stiffness.data(), inertia.data(), most_direct, folded}, threads,
      progress);
  py::dict arrays;
#define X(name, type, width, rows, meaning) arrays[#name] = as_array(tables.name, width);
#include "views/multilevel.def"
#undef X
  return arrays;
}

// What a GPU sums up by pairs of pieces, of a preconditioner's arrays and the corners of tetrahedra in the plan's order.
inline py::dict list_pieces(int pieces, const Numbers& of, const Doubles& weight,
                            const Numbers& fine_start, const Numbers& fine_column,
                            const Numbers& corners) {
  const auto span = [](const auto& array) {
    return std::span(array.data(), std::size_t(array.size()));
  };
  pd::PieceLists lists = pd::list_pieces(
      {pieces, span(of), span(weight), span(fine_start), span(fine_column), span(corners)});
  py::dict arrays;
  const auto add = [&](const char* name, pd::PairList& list) {
    const std::string of_kind = std::string("piece_") + name;
    arrays[(of_kind + "_start").c_str()] = as_array(list.start, 1);
    arrays[(of_kind + "_task").c_str()] = as_array(list.task, 4);
    arrays[of_kind.c_str()] = as_array(list.item, 1);
  };
  add("row", lists.rows);
  add("tet", lists.tets);
  return arrays;
}

}  // namespace pd::python
