// Every check of an op's arguments, and nothing else. binding/plan_views.h and
// binding/material_views.h check the arrays of plans and materials.
#pragma once
#include "views/views.h"

#include <ATen/ATen.h>
#include <ATen/MemoryOverlap.h>
#include <c10/util/Exception.h>

#include <cstdint>
#include <string>
#include <vector>

namespace pd {

using at::Tensor;

inline std::string describe(const Tensor& t) {
  return c10::str(at::toString(t.scalar_type()), " ", t.sizes(), " on ", t.device().str());
}

// The place of a call's tensors, and the argument that decides it.
struct Place {
  at::Device device;
  const char* like = "positions";
};

// A contiguous tensor of the given type and place, else an error that names the argument.
inline void check_storage(const Tensor& t, at::ScalarType type, const Place& place,
                          const std::string& name, const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == type, name, " must be ", at::toString(type), " (", meaning,
                   "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device() == place.device, name, " must be on ", place.device.str(), " like ",
                    place.like, " (", meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.is_contiguous(), name, " must be contiguous (", meaning, "), got strides ",
                    t.strides(), "; call contiguous()");
}

// One array of a table, of a plan unless `remedy` names another source: [rows], or [rows, width] if width > 1.
inline void check_array(const Tensor& t, at::ScalarType type, std::int64_t rows, std::int64_t width,
                        const Place& place, const std::string& name, const char* meaning,
                        const char* remedy = "compile the scene again") {
  check_storage(t, type, place, name, meaning);
  std::vector<std::int64_t> shape{rows};
  if (width > 1) shape.push_back(width);
  TORCH_CHECK_VALUE(t.sizes() == at::IntArrayRef(shape), name, " must be ", at::IntArrayRef(shape),
                    " (", meaning, "), got ", describe(t), "; ", remedy);
}

inline void check_tets(const Tensor& stiffness, std::int64_t tets) {
  TORCH_CHECK_VALUE((stiffness.dim() == 1 || stiffness.dim() == 2) && stiffness.size(-1) == tets,
                    "stiffness must be [", tets, "] or [batch, ", tets,
                    "], one value per tetrahedron of the plan [Pa], got ", describe(stiffness));
}

inline void check_state(const Tensor& t, const Tensor& like, const char* name,
                        const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), name, " must be ",
                   at::toString(like.scalar_type()), " like positions (", meaning, "), got ",
                   describe(t));
  TORCH_CHECK_VALUE(t.sizes() == like.sizes(), name, " must be ", like.sizes(), " like positions (",
                    meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device() == like.device(), name, " must be on ", like.device().str(),
                    " like positions (", meaning, "), got ", describe(t));
}

inline void check_real(const Tensor& t, const char* name, const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must be float32 or float64 ", meaning, ", got ", describe(t));
}

inline void check_positions(const Tensor& t, const char* name) {
  check_real(t, name, "[batch, vertices, 3] (m)");
  TORCH_CHECK_VALUE(t.dim() == 3 && t.size(2) == 3, name, " must be [batch, vertices, 3] (m), got ",
                    describe(t));
}

inline void check_vertices(const Tensor& positions, std::int64_t vertices) {
  TORCH_CHECK_VALUE(positions.size(1) == vertices, "positions must have the ", vertices,
                    " vertices of the plan, got ", describe(positions));
}

// Checks the tensors that step_ overwrites.
inline void check_inplace(const Tensor& positions, const Tensor& velocities, const Tensor& info) {
  TORCH_CHECK_VALUE(positions.is_contiguous() && velocities.is_contiguous(),
                    "step_: positions and velocities must be contiguous");
  TORCH_CHECK_VALUE(!positions.is_alias_of(velocities),
                    "step_: positions and velocities must not share memory");
  TORCH_CHECK_VALUE(info.scalar_type() == at::kDouble && info.is_contiguous() && info.dim() == 2 &&
                        info.size(0) == positions.size(0) && info.size(1) == info_count,
                    "info must be a contiguous float64 [", positions.size(0), ", ", int(info_count),
                    "], got ", describe(info));
  TORCH_CHECK_VALUE(info.device() == positions.device(), "info must be on ",
                    positions.device().str(), " like positions, got ", describe(info));
}

inline void check_matrices(const Tensor& t, const char* name) {
  check_real(t, name, "[..., 3, 3]");
  TORCH_CHECK_VALUE(t.dim() >= 2 && t.size(-1) == 3 && t.size(-2) == 3, name,
                    " must be [..., 3, 3], got ", describe(t));
}

// The direction of a matrix derivative.
inline void check_direction(const Tensor& direction, const Tensor& matrices) {
  check_matrices(direction, "direction");
  TORCH_CHECK_VALUE(
      direction.sizes() == matrices.sizes() && direction.scalar_type() == matrices.scalar_type() &&
          direction.device() == matrices.device(),
      "direction must be ", describe(matrices), " like matrices, got ", describe(direction));
}

// Projector of every vertex on its free directions.
inline void check_projector(const Tensor& t, const Tensor& like) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), "projector must be ",
                   at::toString(like.scalar_type()), " like the vectors, got ", describe(t));
  TORCH_CHECK_VALUE(t.sizes() == at::IntArrayRef({like.size(0), like.size(1), 3, 3}) &&
                        t.device() == like.device(),
                    "projector must be [batch, vertices, 3, 3] beside the vectors, got ",
                    describe(t));
}

inline void check_sliding(const Tensor& t, const Tensor& like) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), "sliding must be ",
                   at::toString(like.scalar_type()), " like the vectors, got ", describe(t));
  TORCH_CHECK_VALUE(t.sizes() == at::IntArrayRef({like.size(0), like.size(1), slide_count, 3}) &&
                        t.device() == like.device(),
                    "sliding must be [batch, vertices, ", int(slide_count),
                    ", 3] beside the vectors, got ", describe(t));
}

}  // namespace pd
