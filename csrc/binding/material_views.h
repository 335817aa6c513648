// Tensors to views: the arrays of a material, and the checks that a plan has their rows.
#pragma once
#include "binding/checks.h"
#include "binding/plan_views.h"
#include "elements/kinds.h"
#include "views/views.h"

#include <ATen/ATen.h>
#include <c10/util/Exception.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace pd {

template <class T>
Values<T> values_view(const Tensor& t, std::int64_t rows, std::int64_t width, bool single,
                      std::int64_t batch, const Place& place, const char* name,
                      const char* meaning) {
  check_storage(t, scalar_type<T>, place, std::string("material.") + name, meaning);
  std::vector<std::int64_t> shape;
  if (!single) shape.push_back(rows);
  if (width > 1) shape.push_back(width);
  const at::IntArrayRef sizes = t.sizes();
  const bool own = sizes.size() == shape.size() + 1 && (sizes[0] == batch || sizes[0] == 1);
  TORCH_CHECK_VALUE((own ? sizes.slice(1) : sizes) == at::IntArrayRef(shape), "material.", name,
                    " must be ", at::IntArrayRef(shape), " or the same after a batch of ", batch,
                    ", as many environments as the positions have (", meaning, "), got ",
                    describe(t));
  return {t.const_data_ptr<T>(), own && sizes[0] == batch ? rows * width : 0};
}

struct Rows {
  std::int64_t tet, vertex, pin, plane, sphere, one = 1;
};

#define X(name, width, rows, meaning) +1
constexpr int material_arrays = 0
#include "views/material.def"
    ;
#undef X

// Arrays of a material with those that only some scenes have.
#define X(name, width, rows, meaning) +1
#define EFFECT X
constexpr int all_material_arrays = 0
#include "views/material.def"
    ;
#undef X

inline void check_material_size(at::TensorList material) {
  TORCH_CHECK_VALUE(material.size() == material_arrays || material.size() == all_material_arrays,
                    "material must be ", material_arrays, " arrays, or ", all_material_arrays,
                    " with those that only some scenes have, got ", material.size());
}

// The place of an array in a material.
constexpr std::size_t place_in_material(std::string_view name) {
  constexpr std::string_view names[] = {
#define X(name, width, rows, meaning) #name,
#define EFFECT X
#include "views/material.def"
#undef X
  };
  std::size_t place = 0;
  while (names[place] != name) ++place;
  return place;
}

// The array of a name.
inline const Tensor& array_of(at::TensorList material, std::string_view name) {
  check_material_size(material);
  return material[place_in_material(name)];
}

// Young's moduli, one for each tetrahedron of a plan.
inline Tensor stiffness_of(at::TensorList material, std::int64_t tets) {
  const Tensor& stiffness = array_of(material, "stiffness");
  check_tets(stiffness, tets);
  return stiffness.contiguous();
}

// Arrays of tetrahedra, and those without which an energy is quadratic, may be absent: zeros.
inline void check_effect(at::TensorList material, std::string_view name, int width, bool of_tets,
                         bool may_lack, const char* kind, std::int64_t count) {
  const Tensor& array = material[place_in_material(name)];
  const int rows = width > 1 ? -2 : -1;
  TORCH_CHECK_VALUE(
      array.dim() >= -rows && (array.size(rows) == count || (may_lack && array.numel() == 0)),
      "material.", name, " must have a row for each of the ", count,
      of_tets ? " tetrahedra" : " stencils", of_tets ? ", which stencils" : "", " of kind ", kind,
      of_tets ? " read, got " : " in the plan, got ", describe(array));
}

// Columns, where an array has any, are all of its numbers.
constexpr int columns_of(std::string_view name) {
  int numbers = 0;
#define X(name, width, rows, meaning)
#define COLUMN(array, column, width, meaning) numbers += name == #array ? width : 0;
#include "views/material.def"
#undef X
  return numbers;
}
#define X(name, width, rows, meaning) \
  static_assert(columns_of(#name) == 0 || columns_of(#name) == width);
#include "views/material.def"
#undef X

inline std::int64_t rows_of(const Tensor& t, int width, const char* name) {
  const int own = width > 1 ? 2 : 1;
  TORCH_CHECK_VALUE(t.dim() == own || t.dim() == own + 1, "material.", name, " must have ", own,
                    " dimensions, or ", own + 1, " with a batch, got ", describe(t));
  return t.size(width > 1 ? -2 : -1);
}

// Whether some stencils of a plan read an array of the material.
inline bool stencils_read(at::TensorList plan, std::string_view name) {
  const auto has_sizes = [&](int arrays, int of_stencils) {
    const int others = int(plan.size()) - arrays;
    return others == of_stencils || others == of_stencils + level_arrays;
  };
  const int at = has_sizes(plan_arrays, stencil_arrays) ? plan_arrays : device_plan_arrays;
  if (at != plan_arrays && !has_sizes(at, device_stencil_arrays)) return false;
  const Tensor& sizes = plan[at];
  constexpr int count = stencil_size_count + int(KindNumber::count);
  if (!sizes.is_cpu() || sizes.numel() != count) return false;
  const int32* const size = sizes.const_data_ptr<int32>() + stencil_size_count;
  bool read = false;
#define KIND(kind, type, what)
#define PARAMETER(kind, array) read = read || (name == #array && size[int(KindNumber::kind)] > 0);
#include "elements/kinds.def"
#undef KIND
  return read;
}

// Every stencil needs its row of each array that its kind reads. `counts`: stencils of each kind; null without any.
inline void check_effects(const int32* counts, std::int64_t tets, at::TensorList material) {
  if (!counts) return;
  TORCH_CHECK_VALUE(material.size() == all_material_arrays, "material must be ",
                    all_material_arrays, " arrays for a plan with stencils, got ", material.size());
#define KIND(kind, type, what)
#define PARAMETER(kind, array)                                                         \
  if (const auto count = counts[int(KindNumber::kind)])                                \
    check_effect(material, #array, array##_numbers, is_of_tets(effect_##array),        \
                 ArraysOf<TypeOf<KindNumber::kind>>().may_lack(effect_##array), #kind, \
                 is_of_tets(effect_##array) ? tets : count);
#include "elements/kinds.def"
#undef KIND
}

// Whether a material has stiffness-proportional damping.
inline bool has_damping(at::TensorList material) {
  return material.size() > material_arrays && array_of(material, "stiffness_damping").size(-1) > 0;
}

// Whether a step leaves something for the next one.
inline bool has_history(at::TensorList material) {
  bool found = false;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning)
#define HISTORY(name, width, rows, meaning) \
  found = found || (material.size() > material_arrays && array_of(material, #name).numel() > 0);
#include "views/material.def"
#undef X
  return found;
}

// Whether a material has Poisson's ratio.
inline bool has_poisson(at::TensorList material) {
  return material.size() > material_arrays && array_of(material, "poisson").size(-1) > 0;
}

inline void check_poisson(at::TensorList material, std::int64_t tets) {
  const Tensor& poisson = array_of(material, "poisson");
  TORCH_CHECK_VALUE(poisson.dim() >= 1 && (poisson.size(-1) == 0 || poisson.size(-1) == tets),
                    "material.poisson must be [", tets, "] or [batch, ", tets,
                    "], one value per tetrahedron of the plan, or [0] in a scene without, got ",
                    describe(poisson));
}

// The arrays that only some scenes have.
template <class T>
Effects<T> effects_view(const int32* counts, std::int64_t tets, at::TensorList arrays,
                        std::int64_t batch, const Place& place) {
  Effects<T> effects;
  check_effects(counts, tets, arrays);
  if (arrays.size() == material_arrays) return effects;
  check_poisson(arrays, tets);
  int at = material_arrays;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning)                                                        \
  if (const std::int64_t count = rows_of(arrays[at], width, #name); count > 0)                    \
    effects.name = values_view<T>(arrays[at], count, width, false, batch, place, #name, meaning); \
  ++at;
#include "views/material.def"
#undef X
  return effects;
}

// Those arrays made contiguous, and their view.
template <class T>
struct EffectArrays {
  std::vector<Tensor> kept;
  Effects<T> view;

  EffectArrays(const int32* counts, std::int64_t tets, at::TensorList material, std::int64_t batch,
               const Place& place) {
    if (material.size() > material_arrays) {
      for (const Tensor& array : material) kept.push_back(array.contiguous());
      view = effects_view<T>(counts, tets, kept, batch, place);
    } else {
      check_effects(counts, tets, material);
    }
  }
};

// Environments of the elastic material; none where all share it.
inline std::optional<std::int64_t> environments_of(at::TensorList material) {
  std::optional<std::int64_t> own;
  const auto raise = [&](std::int64_t count) { own = std::max(own.value_or(0), count); };
  if (array_of(material, "stiffness").dim() == 2) raise(material[0].size(0));
  std::size_t at = material_arrays;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning)                               \
  if (at < material.size() && material[at].dim() == (width > 1 ? 3 : 2)) \
    raise(material[at].size(0));                                         \
  ++at;
#include "views/material.def"
#undef X
  return own;
}

template <class T, class P>
Material<T> material_view(const P& plan, at::TensorList arrays, std::int64_t batch,
                          const Place& place) {
  check_material_size(arrays);
  Material<T> material;
  Rows count{};
  count.vertex = plan.vertices;
  count.pin = plan.pins;
  int at = 0;
#define X(name, width, rows, meaning)                                                          \
  if (std::string(#rows) == "tet") count.tet = rows_of(arrays[at], width, #name);              \
  if (std::string(#rows) == "plane") count.plane = rows_of(arrays[at], width, #name);          \
  if (std::string(#rows) == "sphere") count.sphere = rows_of(arrays[at], width, #name);        \
  material.name = values_view<T>(arrays[at++], count.rows, width, std::string(#rows) == "one", \
                                 batch, place, #name, meaning);
#include "views/material.def"
#undef X
  material.planes_count = int(count.plane);
  material.spheres_count = int(count.sphere);
  return material;
}

}  // namespace pd
