// Tensors to views: every check of an op's arguments, and nothing else.
#pragma once
#include "plan/views.h"

#include <ATen/ATen.h>
#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

namespace pd {

using at::Tensor;

template <class T>
constexpr at::ScalarType scalar_type = sizeof(T) == 4 ? at::kFloat : at::kDouble;
template <>
constexpr at::ScalarType scalar_type<int32> = at::kInt;
template <>
constexpr at::ScalarType scalar_type<int16> = at::kShort;

inline std::string describe(const Tensor& t) {
  return c10::str(at::toString(t.scalar_type()), " ", t.sizes(), " on ", t.device().str());
}

// A contiguous CPU tensor of the given type, else an error that says what the argument is.
inline void check_storage(const Tensor& t, at::ScalarType type, const std::string& name,
                          const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == type, name, " must be ", at::toString(type), " (", meaning,
                   "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device().is_cpu(), name, " must be on cpu like the other arguments (",
                    meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.is_contiguous(), name, " must be contiguous (", meaning, "), got strides ",
                    t.strides());
}

#define X(name, type, width, rows, meaning) +1
constexpr int plan_arrays = 0
#include "plan/plan.def"
    ;
#undef X

template <class T>
Plan<T> plan_view(at::TensorList arrays) {
  TORCH_CHECK_VALUE(arrays.size() == plan_arrays, "plan must be the ", plan_arrays,
                    " arrays of Plan.arrays, got ", arrays.size());
  Plan<T> plan;
  int at = 0;
  using real = T;
#define X(name, type, width, rows, meaning)                                                        \
  check_storage(arrays[at], scalar_type<type>, "plan." #name, meaning);                            \
  TORCH_CHECK_VALUE(                                                                               \
      arrays[at].dim() == (width > 1 ? 2 : 1) && (width == 1 || arrays[at].size(1) == width),      \
      "plan." #name " must be [" #rows, width > 1 ? ", " #width "] (" : "] (", meaning, "), got ", \
      describe(arrays[at]));                                                                       \
  const int name##_rows = int(arrays[at].size(0));                                                 \
  plan.name = arrays[at++].const_data_ptr<type>();
#include "plan/plan.def"
#undef X
  TORCH_CHECK_VALUE(
      patch_block_rows >= 2 && patch_vertex_rows == patch_block_rows &&
          patch_slot_rows == patch_block_rows && tet_rest_rows == tet_order_rows &&
          tet_volume_rows == tet_order_rows && tet_bound_rows == tet_order_rows &&
          tet_corner_rows == tet_order_rows && vertex_group_rows == vertex_order_rows &&
          shared_start_rows >= 1,
      "plan: arrays that belong together have different lengths; compile the scene again");
  plan.vertices = vertex_order_rows;
  plan.blocks = tet_order_rows;
  plan.tets = tet_lane_rows;
  plan.pins = pin_vertex_rows;
  plan.groups = group_size_rows;
  plan.patches = patch_block_rows - 1;
  plan.slots = slot_vertex_rows;
  plan.shared = shared_start_rows - 1;
  for (int p = 0; p < plan.patches; ++p) {
    plan.most_slots = std::max(plan.most_slots, plan.patch_slot[p + 1] - plan.patch_slot[p]);
  }
  TORCH_CHECK_VALUE(plan.patch_block[plan.patches] == plan.blocks &&
                        plan.patch_slot[plan.patches] == plan.slots &&
                        plan.patch_vertex[plan.patches] + plan.shared == plan.vertices &&
                        plan.shared_start[plan.shared] == shared_slot_rows,
                    "plan: the ends of the patches do not match the lengths of the arrays; compile "
                    "the scene again");
  return plan;
}

template <class T>
Values<T> values_view(const Tensor& t, std::int64_t rows, std::int64_t width, bool single,
                      std::int64_t batch, const char* name, const char* meaning) {
  check_storage(t, scalar_type<T>, std::string("material.") + name, meaning);
  std::vector<std::int64_t> shape;
  if (!single) shape.push_back(rows);
  if (width > 1) shape.push_back(width);
  const at::IntArrayRef sizes = t.sizes();
  const bool own = sizes.size() == shape.size() + 1 && (sizes[0] == batch || sizes[0] == 1);
  TORCH_CHECK_VALUE((own ? sizes.slice(1) : sizes) == at::IntArrayRef(shape), "material.", name,
                    " must be ", at::IntArrayRef(shape), " or the same after a batch of ", batch,
                    " (", meaning, "), got ", describe(t));
  return {t.const_data_ptr<T>(), own && sizes[0] == batch ? rows * width : 0};
}

struct Rows {
  std::int64_t tet, vertex, pin, plane, sphere, one = 1;
};

#define X(name, width, rows, meaning) +1
constexpr int material_arrays = 0
#include "plan/material.def"
    ;
#undef X

inline std::int64_t rows_of(const Tensor& t, int width, const char* name) {
  const int own = width > 1 ? 2 : 1;
  TORCH_CHECK_VALUE(t.dim() == own || t.dim() == own + 1, "material.", name, " must have ", own,
                    " dimensions, or ", own + 1, " with a batch, got ", describe(t));
  return t.size(width > 1 ? -2 : -1);
}

template <class T>
Material<T> material_view(at::TensorList arrays, std::int64_t vertices, std::int64_t pins,
                          std::int64_t batch) {
  TORCH_CHECK_VALUE(arrays.size() == material_arrays, "material must be ", material_arrays,
                    " arrays, got ", arrays.size());
  Material<T> material;
  Rows count{0, vertices, pins, 0, 0};
  int at = 0;
#define X(name, width, rows, meaning)                                                          \
  if (std::string(#rows) == "tet") count.tet = rows_of(arrays[at], width, #name);              \
  if (std::string(#rows) == "plane") count.plane = rows_of(arrays[at], width, #name);          \
  if (std::string(#rows) == "sphere") count.sphere = rows_of(arrays[at], width, #name);        \
  material.name = values_view<T>(arrays[at++], count.rows, width, std::string(#rows) == "one", \
                                 batch, #name, meaning);
#include "plan/material.def"
#undef X
  material.planes_count = int(count.plane);
  material.spheres_count = int(count.sphere);
  return material;
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

inline void check_positions(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must be float32 or float64 [batch, vertices, 3] (m), got ", describe(t));
  TORCH_CHECK_VALUE(t.dim() == 3 && t.size(2) == 3, name, " must be [batch, vertices, 3] (m), got ",
                    describe(t));
}

inline void check_vertices(const Tensor& positions, std::int64_t vertices) {
  TORCH_CHECK_VALUE(positions.size(1) == vertices, "positions must have the ", vertices,
                    " vertices of the plan, got ", describe(positions));
}

}  // namespace pd
