// All kinds of stencils, and loops over them, from the table in elements/kinds.def.
#pragma once
#include "elements/cloth_limit.h"
#include "elements/damper.h"
#include "elements/fibre.h"
#include "elements/hinge.h"
#include "elements/plastic.h"
#include "elements/solid_limit.h"
#include "elements/spring.h"
#include "elements/thread.h"
#include "elements/tie.h"
#include "elements/triangle.h"
#include "elements/volume.h"

#include <string_view>
#include <type_traits>

namespace pd::inline PD_TARGET {

// The kinds by name, numbered in the order of the table.
enum class KindNumber : int {
#define KIND(name, type, what) name,
#include "elements/kinds.def"
#undef KIND
  count
};

template <KindNumber number>
struct KindOf;
#define KIND(name, type, what)      \
  template <>                       \
  struct KindOf<KindNumber::name> { \
    using Type = type;              \
  };
#include "elements/kinds.def"
#undef KIND
template <KindNumber number>
using TypeOf = typename KindOf<number>::Type;

template <class Kind>
constexpr int kind_number = -1;
#define KIND(name, type, what) \
  template <>                  \
  constexpr int kind_number<type> = int(KindNumber::name);
#include "elements/kinds.def"
#undef KIND

// visit(Kind{}) for the kind of a number
template <class Visit>
PD_HD void with_kind(int number, const Visit& visit) {
  switch (KindNumber(number)) {
#define KIND(name, type, what) \
  case KindNumber::name:       \
    visit(type{});             \
    break;
#include "elements/kinds.def"
#undef KIND
    case KindNumber::count:
      break;
  }
}

// Whether an array has a row for every tetrahedron, by its number.
constexpr bool is_of_tets(int effect) {
  if (effect == effect_stiffness) return true;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) \
  if (effect == effect_##name) return std::string_view(#rows) == "tet";
#include "views/material.def"
#undef X
  return false;
}

template <class Kind>
constexpr int array_count = 0
#define KIND(name, type, what)
#define PARAMETER(kind, array) +int(std::is_same_v<Kind, TypeOf<KindNumber::kind>>)
#include "elements/kinds.def"
#undef KIND
    ;

// The arrays of the material that a kind reads, in the order of its `parameters`, and which numbers of a row each has.
template <class Kind>
struct ArraysOf {
  static constexpr int count = array_count<Kind>;
  int effect[count];     // EffectNumber
  int first[count + 1];  // of the numbers, and their end
  bool of_tets = false;

  constexpr ArraysOf() : effect{}, first{} {
    int at = 0;
#define KIND(name, type, what)
#define PARAMETER(kind, array)                                    \
  if constexpr (std::is_same_v<Kind, TypeOf<KindNumber::kind>>) { \
    effect[at] = effect_##array;                                  \
    first[at + 1] = first[at] + array##_numbers;                  \
    ++at;                                                         \
  }
#include "elements/kinds.def"
#undef KIND
    of_tets = is_of_tets(effect[0]);
  }
  PD_HD constexpr int width(int array) const { return first[array + 1] - first[array]; }
  // whether a scene may lack an array, which is zero then
  PD_HD constexpr bool may_lack(int wanted) const {
    for (int i = 0; i < count; ++i) {
      if (effect[i] == wanted)
        return of_tets || (quadratic_arrays<Kind> > 0 && i >= quadratic_arrays<Kind>);
    }
    return false;
  }
  // all arrays have the same rows, and as many numbers as the kind reads
  constexpr bool fit() const {
    for (int i = 0; i < count; ++i) {
      if (is_of_tets(effect[i]) != of_tets) return false;
    }
    return first[count] == Kind::rows && (quadratic_arrays<Kind> == 0 || Kind::dims == 1);
  }
};
#define KIND(name, type, what) static_assert(ArraysOf<type>().fit());
#include "elements/kinds.def"
#undef KIND

// Whether the rows of a kind are those of its tetrahedra.
template <class Kind>
constexpr bool reads_tets = ArraysOf<Kind>().of_tets;

// Whether holds(kind) for a kind of which a plan has stencils. `counts`: of each kind.
template <class Holds>
bool any_kind(const int32* counts, const Holds& holds) {
  bool found = false;
  for (int number = 0; number < int(KindNumber::count); ++number)
    with_kind(number, [&](auto kind) { found = found || (counts[number] > 0 && holds(kind)); });
  return found;
}

// The array of the material that holds the history of a kind.
template <class Kind>
constexpr int history_effect = ArraysOf<Kind>().effect[array_count<Kind> - 1];

// Whether a GPU has kernels for a kind: none that keeps a history, yet.
template <class Kind>
constexpr bool runs_on_gpu = history_of<Kind> == 0;

// The counts of a plan's stencils and of their rows, from their arrays of sizes; without the other arrays.
template <class T>
DeviceStencils<T> count_device_stencils(const int32* sizes, const int32* row_sizes) {
  DeviceStencils<T> stencils;
  const int32* const counts = sizes + stencil_size_count;
  stencils.blocks = sizes[stencil_blocks];
  stencils.number_rows = sizes[stencil_number_rows];
  for (int i = 0; i < row_size_count; ++i) stencils.rows[i] = row_sizes[i];
  stencils.remembers = any_kind(counts, [](auto kind) { return memory_of<decltype(kind)> > 0; });
  stencils.reads_tets = any_kind(counts, [](auto kind) { return reads_tets<decltype(kind)>; });
  return stencils;
}

// The rows of those arrays in one environment. An array that the scene lacks has zeros.
template <class Kind, class T>
struct MaterialRows {
  const T* row[array_count<Kind>];

  PD_HD MaterialRows(const Effects<T>& effects, std::int64_t environment) {
    int at = 0;
#define KIND(name, type, what)
#define PARAMETER(kind, array)                                  \
  if constexpr (std::is_same_v<Kind, TypeOf<KindNumber::kind>>) \
    row[at++] = effects.array.data ? effects.array.of(environment) : nullptr;
#include "elements/kinds.def"
#undef KIND
  }

  // the numbers of a row
  PD_HD void values(std::int64_t number, T (&value)[Kind::rows]) const {
    constexpr ArraysOf<Kind> arrays;
    for (int a = 0; a < arrays.count; ++a) {
      const int width = arrays.width(a);
      for (int i = 0; i < width; ++i)
        value[arrays.first[a] + i] = row[a] ? row[a][number * width + i] : T(0);
    }
  }

  // numbers of a step of one stencil, whose rows have this number; without its memory
  PD_HD void read(std::int64_t number, T measure, T (&p)[Kind::numbers]) const {
    T value[Kind::rows] = {};
    values(number, value);
    Kind::parameters(value, measure, p);
  }
};

}  // namespace pd::inline PD_TARGET
