// `torchpd._C`: mesh work on NumPy arrays, the tables, and how it was built. Loading it also registers the ops.
#include "binding/settings.h"
#include "cpu/dispatch.h"
#include "cuda/common/launch.h"
#include "cuda/poisson/launch.h"
#include "elements/kinds.h"
#include "plan/cpu/build.h"
#include "plan/gpu/build.h"
#include "plan/multilevel/build.h"
#include "solver/adjoint/system.h"
#include "solver/multilevel/lbfgs.h"
#include "threads/team.h"
#include "views/shared_memory.h"

#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <map>
#include <optional>
#include <span>
#include <stdexcept>
#include <vector>

namespace py = pybind11;

namespace {

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

void check_mesh(const Doubles& positions, const Indices& tets, bool others = false) {
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

// The shape of a kind of stencils, see elements/stencil.h.
struct KindShape {
  const char* name;
  int corners, dims, constants, numbers;
  bool of_tets;  // whether it reads the material of tetrahedra
  std::vector<std::string> rows;
  const char* meaning;
  bool large;     // see elements/stencil.h
  int quadratic;  // arrays that make its energy quadratic; 0: none do
  bool on_gpu;    // whether a GPU has kernels for it
  bool keeps_axes;
};

std::vector<KindShape> kind_shapes() {
  std::vector<KindShape> kinds;
#define KIND(name, type, what)                     \
  kinds.push_back({#name,                          \
                   pd::type::corners,              \
                   pd::type::dims,                 \
                   pd::type::constants,            \
                   pd::type::numbers,              \
                   pd::reads_tets<pd::type>,       \
                   {},                             \
                   what,                           \
                   pd::is_large<pd::type>,         \
                   pd::quadratic_arrays<pd::type>, \
                   pd::runs_on_gpu<pd::type>,      \
                   pd::keeps_axes<pd::type>});
#define PARAMETER(name, array) kinds.back().rows.push_back(#array);
#include "elements/kinds.def"
#undef KIND
  return kinds;
}

// Stencils of one kind as Python gives them: kind, corners, g_a, V, constants, the tetrahedron of each if the kind
// reads its material, and whether their energy is quadratic.
using Stencils = std::tuple<int, Indices, Doubles, Doubles, Doubles, std::optional<Indices>, bool>;

void check_tets_of(const KindShape& shape, const std::optional<Indices>& row, py::ssize_t count,
                   std::int64_t tets) {
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

pd::StencilGroup stencil_group(const Stencils& given, std::int64_t vertices, std::int64_t tets) {
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
pd::MeshElements mesh_elements(const Doubles& positions, const Indices& tets,
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
void add_kinds(std::vector<std::int32_t>& sizes, const pd::MeshElements& elements) {
  sizes.resize(pd::stencil_size_count + int(pd::KindNumber::count), 0);
  for (const pd::StencilGroup& group : elements.groups)
    sizes[pd::stencil_size_count + group.kind] = std::int32_t(group.count);
}

std::vector<std::int32_t> stencil_sizes(const pd::MeshPlan& plan, const pd::MeshElements& elements,
                                        int lanes) {
  std::vector<std::int32_t> sizes(pd::stencil_size_count);
  sizes[pd::stencil_blocks] = std::int32_t(plan.stencil_block.size() / 4);
  sizes[pd::stencil_corner_rows] = std::int32_t(plan.stencil_corner.size() / lanes);
  sizes[pd::stencil_stored_rows] = std::int32_t(plan.stencil_stored.size() / lanes);
  sizes[pd::stencil_number_rows] = plan.stencil_numbers;
  add_kinds(sizes, elements);
  return sizes;
}

// Groups of tetrahedra that average their trace, from the number of each tetrahedron's.
pd::TetGroups tet_groups(const std::optional<Indices>& group, const Indices& tets) {
  if (!group || tets.shape(0) == 0) return {};
  if (group->ndim() != 1 || group->shape(0) != tets.shape(0))
    throw py::value_error("tet_group must be int64 [tets], the number of each one's group");
  return pd::groups_of(group->data(), tets.data(), tets.shape(0));
}

py::dict build_plan(const Doubles& positions, const Indices& tets,
                    const std::vector<Stencils>& stencils, const std::optional<Indices>& tet_group,
                    int patch_size, const std::function<void(double)>& progress) {
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
void check_cluster(std::int64_t vertices, const Indices& tets, int patches) {
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

py::dict build_device_plan(const Doubles& positions, const Indices& tets,
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

py::dict build_multilevel(const Doubles& positions, const Indices& tets,
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

// Tables of constant arrays, in the order in which ops take them.
struct TableRow {
  const char *name, *type;
  int width;
  const char *rows, *meaning;
};

#define X(name, type, width, rows, meaning) TableRow{#name, #type, width, #rows, meaning},
constexpr TableRow plan_rows[] = {
#include "views/cpu_plan.def"
};
constexpr TableRow stencil_rows[] = {
#include "views/cpu_stencils.def"
};
constexpr TableRow multilevel_rows[] = {
#include "views/multilevel.def"
};
constexpr TableRow device_plan_rows[] = {
#include "views/gpu_plan.def"
};
constexpr TableRow device_stencil_rows[] = {
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
};
#undef X

py::list table(std::span<const TableRow> rows) {
  py::list all;
  for (const TableRow& row : rows)
    all.append(py::make_tuple(row.name, row.type, row.width, row.rows, row.meaning));
  return all;
}

py::list material_table() {
  py::list rows;
#define X(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, false, false));
#define EFFECT(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, true, false));
#define HISTORY(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, true, true));
#include "views/material.def"
#undef X
  return rows;
}

py::list material_columns() {
  py::list columns;
#define X(name, width, rows, meaning)
#define COLUMN(array, name, width, meaning) \
  columns.append(py::make_tuple(#array, #name, int(pd::array##_##name), width, meaning));
#include "views/material.def"
#undef X
  return columns;
}

py::list settings_table() {
  using namespace pd;
  py::list rows;
#define X(name, type, usual, holds, contract, meaning) \
  rows.append(py::make_tuple(#name, schema_type<type>, Given<type>(usual), contract, meaning));
#include "views/settings.def"
#undef X
  return rows;
}

py::list kind_table() {
  py::list rows;
  for (const KindShape& kind : kind_shapes())
    rows.append(py::make_tuple(kind.name, kind.corners, kind.dims, kind.constants,
                               py::tuple(py::cast(kind.rows)), kind.meaning, kind.quadratic,
                               kind.on_gpu));
  return rows;
}

py::list device_sizes() {
  py::list names;
#define X(name, meaning) names.append(#name);
#include "views/gpu_sizes.def"
#undef X
  return names;
}

py::dict build_info() {
  py::dict info;
  info["simd"] = pd::kernels().name;
  info["simd_available"] = pd::supported_simd();
#if defined(_OPENMP)
  info["openmp"] = _OPENMP;
#else
  info["openmp"] = 0;
#endif
#if defined(TORCHPD_CUDA)
  info["cuda"] = true;
#else
  info["cuda"] = false;
#endif
#if defined(__clang__)
  info["compiler"] = "clang " __clang_version__;
#else
  info["compiler"] = "gcc " __VERSION__;
#endif
  info["cxx"] = long(__cplusplus);
  return info;
}

// Memory that a step needs on the current CUDA device, for a plan of given counts.
template <class T>
std::int64_t bytes_of([[maybe_unused]] const pd::MixedStep<T>& step) {
#if defined(TORCHPD_CUDA)
  const bool poisson = step.plan.members > 0;
  if (step.stencils.blocks > 0)
    return poisson ? pd::poisson::mixed_step_bytes(step) : pd::mixed_step_bytes(step);
  return poisson ? pd::poisson::step_bytes(step) : pd::step_bytes<T>(step);
#else
  throw std::runtime_error("this build of torchpd has no CUDA kernels");
#endif
}

template <class T>
std::int64_t step_bytes(const Numbers& sizes, const Numbers& level_sizes,
                        const Numbers& stencil_sizes, const Numbers& row_sizes, int schedule,
                        std::int64_t batch, int planes, int spheres, bool own_stiffness,
                        bool own_effects) {
  const bool levels = level_sizes.size() > 0, stencils = stencil_sizes.size() > 0;
  if (sizes.size() != pd::size_count || (levels && level_sizes.size() != pd::level_size_count) ||
      (stencils && (stencil_sizes.size() != pd::stencil_size_count + int(pd::KindNumber::count) ||
                    row_sizes.size() != pd::row_size_count)))
    throw py::value_error(
        "sizes, level_sizes, stencil_sizes and row_sizes must be those of a plan for a GPU");
  pd::MixedStep<T> step;
  step.plan = pd::count_device_plan<T>(sizes.data());
  if (levels) step.plan.levels = pd::count_levels<T>(level_sizes.data(), step.plan.vertices);
  step.settings.schedule = pd::ScheduleKind(schedule);
  step.batch = batch;
  step.material.planes_count = planes;
  step.material.spheres_count = spheres;
  step.material.stiffness.stride = own_stiffness ? step.plan.tets : 0;
  if (stencils)
    step.stencils = pd::count_device_stencils<T>(stencil_sizes.data(), row_sizes.data());
  step.effects.stiffness = step.material.stiffness;
  // whichever of them it is
  step.effects.bending.stride = own_effects ? 1 : 0;
  return bytes_of(step);
}

unsigned long main_thread = 0;

// Runs pending signal handlers, as Python does between two instructions; that of Ctrl-C raises KeyboardInterrupt.
// Only the main thread has any.
void run_signal_handlers() {
  if (PyThread_get_thread_ident() != main_thread) return;
  const PyGILState_STATE held = PyGILState_Ensure();
  std::optional<py::error_already_set> raised;
  if (PyErr_CheckSignals() != 0) raised.emplace();
  PyGILState_Release(held);
  if (raised) throw *raised;
}

// float32 multiply-adds per second of one thread of this processor
double multiply_adds_per_second() {
  float seconds = 0;
  std::int64_t operations = 0;
  pd::kernels().flops(&seconds, &operations);
  return double(operations) / seconds;
}

}  // namespace

PYBIND11_MODULE(_C, m) {
  m.doc() =
      "Mesh work, tables and build information of torchpd; loading it registers the ops "
      "torchpd::*.";
  main_thread =
      py::module_::import("threading").attr("main_thread")().attr("ident").cast<unsigned long>();
  pd::Interrupt::set_check(&run_signal_handlers);
  m.def("build_plan", &build_plan, py::arg("positions"), py::arg("tets"), py::arg("stencils"),
        py::arg("tet_group"), py::arg("patch_size"), py::arg("progress"));
  m.def("build_device_plan", &build_device_plan, py::arg("positions"), py::arg("tets"),
        py::arg("stencils"), py::arg("patches"), py::arg("kernel"), py::arg("fixed"),
        py::arg("piece"), py::arg("progress"), py::arg("tet_group") = py::none());
  m.def("build_multilevel", &build_multilevel, py::arg("positions"), py::arg("tets"),
        py::arg("stencils"), py::arg("vertex_order"), py::arg("stiffness"), py::arg("inertia"),
        py::arg("most_direct"), py::arg("folded"), py::arg("threads"), py::arg("progress"));
  m.def(
      "plan_table", [] { return table(plan_rows); },
      "Rows (name, type, width, rows, meaning) of the constant arrays, in op order.");
  m.def(
      "stencil_table", [] { return table(stencil_rows); },
      "Rows (name, type, width, rows, meaning) of the constant arrays of stencils, in op order.");
  m.def("kind_table", &kind_table,
        "Rows (name, corners, dims, constants, arrays, meaning, quadratic, on GPU) of the kinds of "
        "stencils.");
  m.def(
      "multilevel_table", [] { return table(multilevel_rows); },
      "Rows (name, type, width, rows, meaning) of a preconditioner's arrays, in op order.");
  m.def(
      "device_plan_table", [] { return table(device_plan_rows); },
      "Rows (name, type, width, rows, meaning) of the constant arrays on a GPU, in op order.");
  m.def(
      "device_stencil_table", [] { return table(device_stencil_rows); },
      "Rows (name, type, width, rows, meaning) of the arrays of stencils and of their rows on a "
      "GPU, in op order.");
  m.def(
      "row_sizes",
      [] {
        return py::dict(py::arg("step_entries") = int(pd::row_step_entries),
                        py::arg("kinds") = int(pd::row_kinds),
                        py::arg("blocks") = int(pd::row_blocks));
      },
      "Places of counts in row_sizes of a GPU plan.");
  m.def("device_sizes", &device_sizes, "Names of the numbers in a GPU plan's sizes.");
  m.def("material_table", &material_table,
        "Rows (name, width, rows, meaning, effect) of the differentiable arrays, in op order.");
  m.def("material_columns", &material_columns,
        "Rows (array, name, first, width, meaning) of the columns that those arrays have.");
  m.def("settings_table", &settings_table,
        "Rows (name, type, usual, contract, meaning) of the settings of a step, in op order.");
  m.attr("info_numbers") = int(pd::info_count);
  m.attr("slide_vectors") = int(pd::slide_count);
  m.def("fused_shared_bytes", &pd::fused_shared_bytes, py::arg("real"), py::arg("many"),
        py::arg("slots"), py::arg("entries"), py::arg("planes"), py::arg("spheres"),
        "Shared memory of a block of the kernels block and (many patches) grid.");
  m.def(
      "fits_cluster",
      [](std::size_t real, std::size_t pairs, std::size_t interior) {
        return pd::cluster_threads(real, pairs, interior) <= pd::most_patch_threads(real);
      },
      py::arg("real"), py::arg("pairs"), py::arg("interior"),
      "Whether a block of a cluster has a thread for everything in a patch of such sizes.");
  m.def("cluster_threads", &pd::cluster_threads, py::arg("real"), py::arg("pairs"),
        py::arg("interior"), "Threads of a block of the kernel cluster.");
  m.def("cluster_shared_bytes", &pd::cluster_shared_bytes, py::arg("real"), py::arg("slots"),
        py::arg("entries"), py::arg("interior"), py::arg("planes"), py::arg("spheres"),
        "Shared memory of a block of the kernel cluster.");
  m.attr("most_cluster_blocks") = pd::most_cluster_blocks;
  m.def(
      "largest_cluster",
      [] {
#if defined(TORCHPD_CUDA)
        return pd::largest_cluster();
#else
        return 1;
#endif
      },
      "Blocks of the largest cluster that the current CUDA device runs; 1: none.");
  m.def(
      "step_bytes",
      [](std::size_t real, const Numbers& sizes, const Numbers& level_sizes,
         const Numbers& stencil_sizes, const Numbers& row_sizes, int schedule, std::int64_t batch,
         int planes, int spheres, bool own_stiffness, bool own_effects) {
        const auto bytes = real == sizeof(float) ? step_bytes<float> : step_bytes<double>;
        return bytes(sizes, level_sizes, stencil_sizes, row_sizes, schedule, batch, planes, spheres,
                     own_stiffness, own_effects);
      },
      py::arg("real"), py::arg("sizes"), py::arg("level_sizes"), py::arg("stencil_sizes"),
      py::arg("row_sizes"), py::arg("schedule"), py::arg("batch"), py::arg("planes"),
      py::arg("spheres"), py::arg("own_stiffness"), py::arg("own_effects"),
      "Memory that the current CUDA device wants for a step; level_sizes: none without a "
      "preconditioner; stencil_sizes, row_sizes: none without stencils.");
  m.attr("outer_static_bytes") = pd::outer_static_bytes;
  m.attr("corotation_bytes") = pd::corotation_bytes;
  m.attr("outlier_ratio") = pd::outlier_ratio;
  m.attr("adjoint_tolerance") =
      std::make_pair(pd::adjoint_tolerance<float>, pd::adjoint_tolerance<double>);
  m.attr("adjoint_failed") = pd::adjoint_failed;
  m.attr("adjoint_iterations") = pd::adjoint_iterations;
  m.attr("most_environments") = pd::most_environments;
  m.attr("most_sharing_pairs") = pd::most_sharing_pairs;
  m.attr("pass_static_bytes") = pd::pass_static_bytes;
  m.def("pass_shared_bytes", &pd::pass_shared_bytes, py::arg("real"), py::arg("slots"),
        py::arg("entries"), py::arg("fields"),
        "Shared memory of a block of the kernel stream and of energies and their derivatives.");
  m.def("outer_shared_bytes", &pd::outer_shared_bytes, py::arg("real"), py::arg("slots"),
        py::arg("entries"), "Shared memory of a block of the multilevel solver.");
  m.def("build_info", &build_info, "What this build can do on this machine.");
  m.def("multiply_adds_per_second", &multiply_adds_per_second,
        "float32, one thread, widest SIMD: for comparing machines.");
}
