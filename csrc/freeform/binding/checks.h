// Tensors to views for the ops of free-form patches.
#pragma once
#include "binding/checks.h"
#include "freeform/tasks.h"

#include <cstdint>
#include <optional>

namespace pd::freeform {

// A floating-point argument: the precision and the place of `like`, the sizes given, contiguous.
inline Tensor real_argument(const Tensor& t, const Tensor& like, at::IntArrayRef sizes,
                            const char* name, const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), name, " must be ",
                   at::toString(like.scalar_type()), " like the other arguments (", meaning,
                   "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device() == like.device(), name, " must be on ", like.device().str(),
                    " like the other arguments (", meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.sizes() == sizes, name, " must be ", sizes, " (", meaning, "), got ",
                    describe(t));
  return t.contiguous();
}

#define X(name, width, rows, meaning) +1
constexpr int list_arrays = 0
#include "freeform/lists.def"
    ;
constexpr int constraint_arrays = 0
#include "freeform/constraints.def"
    ;
#undef X

inline Lists lists_view(at::TensorList arrays, const Place& place) {
  const char* remedy =
      "take them from FreeFormPatches.lists, and from PatchSamples.lists after them";
  TORCH_CHECK_VALUE(arrays.size() == list_arrays, "lists must be ", list_arrays, " arrays, got ",
                    arrays.size(), "; ", remedy);
  enum Array {
#define X(name, width, rows, meaning) name,
#include "freeform/lists.def"
#undef X
  };
  const auto starts = [&](Array which, const char* name) {
    const Tensor& t = arrays[which];
    TORCH_CHECK_VALUE(t.dim() == 1 && t.size(0) >= 1, "lists.", name,
                      " must be [n + 1], where each of n begins, got ", describe(t));
    return t.size(0) - 1;
  };
  Lists lists;
  lists.patches = starts(patch_start, "patch_start");
  lists.vertices = starts(corner_start, "corner_start");
  lists.quadrics = starts(quadric_start, "quadric_start");
  lists.entries = arrays[entry_quadric].numel();
  lists.samples = arrays[sample_patch].numel();
  struct {
    std::int64_t patch, patch_end, entry, quadric_end, vertex_end, corner, sample;
  } const count{lists.patches,      lists.patches + 1, lists.entries, lists.quadrics + 1,
                lists.vertices + 1, 3 * lists.patches, lists.samples};
#define X(name, width, rows, meaning)                                                             \
  check_array(arrays[name], at::kInt, count.rows, width, place, "lists." #name, meaning, remedy); \
  lists.name = arrays[name].const_data_ptr<int32>();
#include "freeform/lists.def"
#undef X
  return lists;
}

inline Constraints constraints_view(at::TensorList arrays, const Place& place) {
  const char* remedy = "take them from PatchTransport.constraints";
  TORCH_CHECK_VALUE(arrays.size() == constraint_arrays, "constraints must be ", constraint_arrays,
                    " arrays, got ", arrays.size(), "; ", remedy);
  enum Array {
#define X(name, width, rows, meaning) name,
#include "freeform/constraints.def"
#undef X
  };
  TORCH_CHECK_VALUE(
      arrays[tets].dim() == 2 && arrays[tet_start].dim() == 1 && arrays[tet_start].size(0) >= 1,
      "constraints must be tets [n, 4], tet_start [points + 1] and point_tet [4 n], "
      "got ",
      describe(arrays[tets]), " and ", describe(arrays[tet_start]));
  Constraints c;
  c.count = arrays[tets].size(0);
  c.points = arrays[tet_start].size(0) - 1;
  struct {
    std::int64_t constraint, point_end, tet_corner;
  } const count{c.count, c.points + 1, 4 * c.count};
#define X(name, width, rows, meaning)                                                          \
  check_array(arrays[name], at::kInt, count.rows, width, place, "constraints." #name, meaning, \
              remedy);                                                                         \
  c.name = arrays[name].const_data_ptr<int32>();
#include "freeform/constraints.def"
#undef X
  return c;
}

inline void check_batched(const Tensor& t, int dims, const char* name, const char* shape) {
  check_real(t, name, shape);
  TORCH_CHECK_VALUE(t.dim() == dims, name, " must be ", shape, ", got ", describe(t));
}

using OptionalTensor = std::optional<Tensor>;

template <class Work>
void for_precision(const Tensor& like, Work work) {
  if (like.scalar_type() == at::kFloat) {
    work(float());
  } else {
    work(double());
  }
}

template <class T>
const T* read(const Tensor& t) {
  return t.const_data_ptr<T>();
}

template <class T>
T* write(const Tensor& t) {
  return t.mutable_data_ptr<T>();
}

}  // namespace pd::freeform
