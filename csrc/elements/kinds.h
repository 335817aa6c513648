// All kinds of stencils, and loops over them, from the table in elements/kinds.def.
#pragma once
#include "elements/fibre.h"
#include "elements/hinge.h"
#include "elements/spring.h"
#include "elements/thread.h"
#include "elements/tie.h"
#include "elements/triangle.h"

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

// The arrays of the material that a kind reads, in the order of its `parameters`.
template <class Kind>
struct EffectsOf {
  int effect[Kind::rows];  // EffectNumber

  constexpr EffectsOf() : effect{} {
    int at = 0;
#define KIND(name, type, what)
#define PARAMETER(kind, array) \
  if constexpr (std::is_same_v<Kind, TypeOf<KindNumber::kind>>) effect[at++] = effect_##array;
#include "elements/kinds.def"
#undef KIND
  }
};

// The rows of those arrays in one environment.
template <class Kind, class T>
struct MaterialRows {
  const T* row[Kind::rows];

  PD_HD MaterialRows(const Effects<T>& effects, std::int64_t environment) {
    int at = 0;
#define KIND(name, type, what)
#define PARAMETER(kind, array)                                  \
  if constexpr (std::is_same_v<Kind, TypeOf<KindNumber::kind>>) \
    row[at++] = effects.array.of(environment);
#include "elements/kinds.def"
#undef KIND
  }

  // numbers of a step of one stencil, whose rows have this number
  PD_HD void read(std::int64_t number, T measure, T (&p)[Kind::numbers]) const {
    T value[Kind::rows];
    for (int i = 0; i < Kind::rows; ++i) value[i] = row[i][number];
    Kind::parameters(value, measure, p);
  }
};

}  // namespace pd::inline PD_TARGET
