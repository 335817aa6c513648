// `torchpd._C`: mesh work on NumPy arrays, the tables, and how it was built. Loading it also registers the ops.
#include "binding/mesh_work.h"
#include "binding/tables.h"
#include "cpu/dispatch.h"
#include "cuda/common/launch.h"
#include "cuda/poisson/launch.h"
#include "solver/adjoint/system.h"
#include "solver/multilevel/lbfgs.h"
#include "threads/team.h"
#include "views/shared_memory.h"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cstddef>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <utility>

namespace py = pybind11;

namespace {

using namespace pd::python;

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
  m.def("list_pieces", &list_pieces, py::arg("pieces"), py::arg("piece_of"),
        py::arg("piece_weight"), py::arg("fine_start"), py::arg("fine_column"), py::arg("corners"));
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
  m.attr("pieces_bytes") = pd::pieces_bytes;
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
