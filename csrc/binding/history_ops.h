// The ops of what a step leaves for the next one.
#pragma once
#include "binding/ops.h"

#include <vector>

namespace pd {

// For each HISTORY of views/material.def its place in the material, and the number of its array.
struct HistoryPlace {
  std::size_t place;
  int effect, width;
};
inline std::vector<HistoryPlace> history_places() {
  return {
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning)
#define HISTORY(name, width, rows, meaning) {place_in_material(#name), effect_##name, width},
#include "views/material.def"
#undef X
  };
}

inline void check_history(const Tensor& positions, at::TensorList material, double time_step) {
  check_positions(positions, "positions");
  check_material_size(material);
  CheckSetting::time_step(time_step);
  TORCH_CHECK_VALUE(has_history(material),
                    "material must have a history, as of plastic solids, got none");
}

// What the step to these positions leaves for the next one: one array [batch, rows, width] for each HISTORY. The
// material holds what the step before left.
template <class Backend>
std::vector<Tensor> next_history(const Tensor& positions, at::TensorList material,
                                 at::TensorList plan, double time_step) {
  check_history(positions, material, time_step);
  const Tensor none = at::empty({0}, positions.options());
  std::vector<Tensor> products(effect_count, none), kept;
  for (const HistoryPlace& p : history_places()) {
    const std::int64_t rows = rows_of(material[p.place], p.width, "history");
    kept.push_back(at::empty({positions.size(0), rows, p.width}, positions.options()));
    products[p.effect] = kept.back();
  }
  const StepOfField step{time_step};
  if (positions.scalar_type() == at::kFloat) {
    field_typed<Backend, float>(Field::next_history, positions, {}, material, plan, none, {},
                                products, step);
  } else {
    field_typed<Backend, double>(Field::next_history, positions, {}, material, plan, none, {},
                                 products, step);
  }
  return kept;
}

// Derivatives of the product of that with gradients: by positions, then by each array of the effects, of every
// environment.
template <class Backend>
std::vector<Tensor> next_history_vjp(at::TensorList gradients, const Tensor& positions,
                                     at::TensorList material, at::TensorList plan,
                                     double time_step) {
  check_history(positions, material, time_step);
  const std::vector<HistoryPlace> places = history_places();
  TORCH_CHECK_VALUE(gradients.size() == places.size(), "gradients must be one for each of the ",
                    places.size(), " histories, got ", gradients.size());
  StepOfField step{time_step, {}, std::vector<Tensor>(effect_count)};
  for (std::size_t i = 0; i < places.size(); ++i) {
    const auto& [place, effect, width] = places[i];
    const std::int64_t rows = rows_of(material[place], width, "history");
    TORCH_CHECK_VALUE(gradients[i].sizes() == at::IntArrayRef({positions.size(0), rows, width}) &&
                          gradients[i].scalar_type() == positions.scalar_type() &&
                          gradients[i].device() == positions.device(),
                      "gradients must be [", positions.size(0), ", ", rows, ", ", width,
                      "] like the history and ", at::toString(positions.scalar_type()), ", got ",
                      describe(gradients[i]));
    step.history_gradients[effect] = gradients[i].contiguous();
  }
  const Tensor by_positions = at::zeros(positions.sizes(), positions.options());
  std::vector<Tensor> found = stencil_products<Backend>(Field::next_history_product, positions, {},
                                                        material, plan, step, by_positions);
  found[0] = by_positions;
  return found;
}

template <class Backend>
void register_history_ops(torch::Library& m) {
  m.impl("next_history", &next_history<Backend>);
  m.impl("next_history_vjp", &next_history_vjp<Backend>);
}

}  // namespace pd
