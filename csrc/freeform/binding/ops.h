// Common parts of the ops of free-form patches on either device.
//
// A Backend has `run(task, count, like)`, which computes the items of a task on the device of the tensor `like`.
#pragma once
#include "freeform/binding/ray_ops.h"
#include "freeform/binding/surface_ops.h"
#include "freeform/binding/transport_ops.h"

#include <torch/library.h>

namespace pd::freeform {

template <class Backend>
void register_ops(torch::Library& m) {
  m.impl("patch_height", &height<Backend>);
  m.impl("patch_height_vjp", &height_vjp<Backend>);
  m.impl("patch_surface", &surface<Backend>);
  m.impl("patch_surface_vjp", &surface_vjp<Backend>);
  m.impl("patch_field", &solid_field<Backend>);
  m.impl("patch_field_vjp", &solid_field_vjp<Backend>);
  m.impl("patch_deformation", &deformation<Backend>);
  m.impl("patch_deformation_vjp", &deformation_vjp<Backend>);
  m.impl("patch_frames", &frames<Backend>);
  m.impl("patch_frames_vjp", &frames_vjp<Backend>);
  m.impl("patch_surface_rays", &surface_rays<Backend>);
  m.impl("patch_field_rays", &field_rays<Backend>);
}

}  // namespace pd::freeform
