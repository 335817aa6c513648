// The ops of free-form patches: schemas, and their CPU implementation.
//
// Compiled once, for any processor. The work is gathers and sums over a few quadrics, which wider vectors than four
// numbers hardly speed up.
#if defined(__x86_64__)
#define PD_NO_FMA  // x86-64 has it only since AVX2, and a library call would be slow
#endif
#define PD_TARGET freeform_cpu
#include "freeform/binding/ops.h"
#include "threads/team.h"

#include <ATen/Parallel.h>

namespace pd::freeform {
namespace {

struct Cpu {
  // A thread takes 64 items or more.
  template <class Task>
  static void run(const Task& task, std::int64_t count, const Tensor&) {
    const auto useful = std::min<std::int64_t>(at::get_num_threads(), (count + 63) / 64);
    run_team(int(useful), [&](const Team& team) {
      for (std::int64_t i = team.begin(count); i < team.end(count); ++i) item(task, i);
    });
  }
};

}  // namespace

TORCH_LIBRARY_FRAGMENT(torchpd, m) {
  m.def(
      "patch_height(Tensor vertices, Tensor directors, Tensor amplitudes, Tensor centres, Tensor "
      "factors, Tensor barycentrics, Tensor[] lists, *, bool on_surface, bool phong) -> (Tensor, "
      "Tensor)");
  m.def(
      "patch_height_vjp(Tensor grad_heights, Tensor grad_slopes, Tensor heights, Tensor vertices, "
      "Tensor directors, Tensor amplitudes, Tensor centres, Tensor factors, Tensor barycentrics, "
      "Tensor[] lists, *, bool on_surface, bool phong) -> (Tensor, Tensor, Tensor, Tensor, Tensor, "
      "Tensor)");
  m.def(
      "patch_surface(Tensor positions, Tensor frames, Tensor vertices, Tensor directors, Tensor "
      "heights, Tensor slopes, Tensor barycentrics, Tensor[] lists, *, bool phong) -> (Tensor, "
      "Tensor)");
  m.def(
      "patch_surface_vjp(Tensor grad_points, Tensor grad_tangents, Tensor positions, Tensor "
      "frames, Tensor vertices, Tensor directors, Tensor heights, Tensor slopes, Tensor "
      "barycentrics, Tensor[] lists, *, bool phong) -> (Tensor, Tensor, Tensor, Tensor, Tensor, "
      "Tensor, Tensor)");
  m.def(
      "patch_field(Tensor points, Tensor positions, Tensor amplitudes, Tensor matrices, Tensor[] "
      "lists, *, float thickness, bool clip) -> Tensor");
  m.def(
      "patch_field_vjp(Tensor grad, Tensor points, Tensor positions, Tensor amplitudes, Tensor "
      "matrices, Tensor[] lists, *, float thickness, bool clip) -> (Tensor, Tensor, Tensor, "
      "Tensor)");
  m.def(
      "patch_deformation(Tensor positions, Tensor inverse_rest, Tensor? fallback, Tensor[] "
      "constraints, *, float lower, float upper) -> Tensor");
  m.def(
      "patch_deformation_vjp(Tensor grad, Tensor positions, Tensor inverse_rest, Tensor? fallback, "
      "Tensor[] constraints, *, float lower, float upper) -> (Tensor, Tensor, Tensor)");
  m.def("patch_frames(Tensor gradients, Tensor weights, Tensor[] lists) -> Tensor");
  m.def(
      "patch_frames_vjp(Tensor grad, Tensor frames, Tensor gradients, Tensor weights, Tensor[] "
      "lists) -> (Tensor, Tensor)");
  m.def(
      "patch_surface_rays(Tensor origins, Tensor directions, Tensor barycentrics, Tensor cells, "
      "Tensor "
      "weights, Tensor places, Tensor positions, Tensor frames, Tensor vertices, Tensor directors, "
      "Tensor amplitudes, Tensor centres, Tensor factors, Tensor[] lists, *, int level, bool "
      "on_surface, bool phong, bool shape, float near, float far) -> (Tensor, Tensor, Tensor, "
      "Tensor, Tensor)");
  m.def(
      "patch_field_rays(Tensor origins, Tensor directions, Tensor positions, Tensor amplitudes, "
      "Tensor matrices, Tensor order, Tensor[] lists, *, float thickness, bool clip, float near, "
      "float far, bool exhaustive) -> (Tensor, Tensor)");
}

TORCH_LIBRARY_IMPL(torchpd, CPU, m) { register_ops<Cpu>(m); }

}  // namespace pd::freeform
