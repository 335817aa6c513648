// The settings of a step, by views/settings.def: their schema, how the dispatcher passes them one by one, and their checks.
#pragma once
#include "views/views.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>

namespace pd {

// The type of a setting as an argument of an op.
template <class Field>
using Given = std::conditional_t<
    std::is_same_v<Field, double>, double,
    std::conditional_t<std::is_same_v<Field, bool> || std::is_same_v<Field, StartKind>, bool,
                       std::int64_t>>;

template <class Field>
constexpr const char* schema_type = std::is_same_v<Given<Field>, bool>     ? "bool"
                                    : std::is_same_v<Given<Field>, double> ? "float"
                                                                           : "int";

// The settings as arguments of an op.
struct Numbers {
#define X(name, type, usual, holds, contract, meaning) Given<type> name;
#include "views/settings.def"
#undef X
};

inline auto in_order(const Numbers& n) {
  return std::tuple{
#define X(name, type, usual, holds, contract, meaning) n.name,
#include "views/settings.def"
#undef X
  };
}

// The settings at the end of a schema.
inline std::string settings_schema() {
  std::string text;
#define X(name, type, usual, holds, contract, meaning) \
  text += std::string(text.empty() ? "" : ", ") + schema_type<type> + " " #name;
#include "views/settings.def"
#undef X
  return text;
}

// Makes an op of a function of the settings and other arguments; the settings are the op's last arguments, one by
// one.
template <class Function, class = decltype(in_order({}))>
struct WithSettings;

template <class Result, class... Others, class... Types>
struct WithSettings<Result(const Numbers&, Others...), std::tuple<Types...>> {
  using Op = Result(Others..., Types...);

  template <Result (*function)(const Numbers&, Others...)>
  static Result unpacked(Others... others, Types... numbers) {
    return function(Numbers{numbers...}, std::forward<Others>(others)...);
  }

  static Result call(const c10::TypedOperatorHandle<Op>& op, const Numbers& n, Others... others) {
    return std::apply(
        [&](Types... numbers) { return op.call(std::forward<Others>(others)..., numbers...); },
        in_order(n));
  }
};

// The registered form of a function of the settings and other arguments.
template <auto function>
constexpr auto unpacked =
    &WithSettings<std::remove_pointer_t<decltype(function)>>::template unpacked<function>;

constexpr std::int64_t most_count = 1'000'000'000;

// Each raises an error for a value that its setting excludes.
struct CheckSetting {
#define X(name, type, usual, holds, contract, meaning)                   \
  static void name(Given<type> value) {                                  \
    TORCH_CHECK_VALUE(holds, #name " must ", contract, ", got ", value); \
  }
#include "views/settings.def"
#undef X
};

template <class Field>
Field narrowed(Given<Field> value) {
  if constexpr (std::is_same_v<Field, int>) return int(std::min(value, most_count));
  return Field(value);
}

inline Settings settings_of(const Numbers& n, bool given, std::int64_t steps, std::int64_t every) {
  TORCH_CHECK_VALUE(steps >= 0 && every >= 1 && steps <= most_count && every <= most_count,
                    "steps must be 0..1e9 and every 1..1e9, got ", steps, " and ", every);
  Settings s;
  s.steps = int(steps);
  s.every = int(every);
#define X(name, type, usual, holds, contract, meaning) \
  CheckSetting::name(n.name);                          \
  s.name = narrowed<type>(n.name);
#include "views/settings.def"
#undef X
  if (given) s.inertial = StartKind::given;
  return s;
}

}  // namespace pd
