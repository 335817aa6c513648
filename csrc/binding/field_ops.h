// Ops of the elastic energy on either device: its value, derivatives, and diagonal. `Backend`: see binding/ops.h.
#pragma once
#include "binding/checks.h"
#include "binding/material_views.h"
#include "binding/plan_views.h"
#include "views/views.h"

#include <ATen/ATen.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

namespace pd {

using OptionalTensor = std::optional<Tensor>;

// The step that a field belongs to: energies that it dissipates count, with the positions at its start.
struct StepOfField {
  double time_step = 0;                        // none
  Tensor start = {};                           // undefined: `positions` are those at the start
  std::vector<Tensor> history_gradients = {};  // by EffectNumber, undefined where there are none

  template <class T>
  T per_time() const {
    return time_step > 0 ? T(1 / time_step) : T(0);
  }
};

template <class Backend, class T>
void field_typed(Field field, const Tensor& positions, const Tensor& direction,
                 at::TensorList material, at::TensorList plan, const Tensor& out,
                 const Tensor& displacement = {}, const std::vector<Tensor>& products = {},
                 const StepOfField& step = {}) {
  typename Backend::template Field<T> call;
  const Place place{positions.device()};
  call.plan = Backend::template plan_view<T>(plan, place);
  Backend::view_stencils(call, plan, place);
  call.field = field;
  call.batch = positions.size(0);
  check_vertices(positions, call.plan.vertices);
  const Tensor w = stiffness_of(material, call.plan.tets);
  const Tensor x = (step.start.defined() ? step.start : positions).contiguous();
  const Tensor u = step.start.defined() ? positions - step.start : displacement;
  const Tensor d = direction.defined() ? direction.contiguous() : Tensor();
  call.per_time = step.template per_time<T>();
  call.stiffness = values_view<T>(w, call.plan.tets, 1, false, call.batch, place, "stiffness",
                                  "Young's modulus [Pa]");
  const EffectArrays<T> effects(Backend::stencil_counts(call), call.plan.tets, material, call.batch,
                                place);
  call.effects = effects.view;
  call.effects.stiffness = call.stiffness;
  for (std::size_t i = 0; i < products.size(); ++i) {
    if (products[i].numel() > 0) call.products[i] = products[i].template mutable_data_ptr<T>();
  }
  for (std::size_t i = 0; i < step.history_gradients.size(); ++i) {
    const Tensor& given = step.history_gradients[i];
    if (given.defined()) call.history_gradients[i] = given.template const_data_ptr<T>();
  }
  call.positions = x.const_data_ptr<T>();
  call.direction = d.defined() ? d.const_data_ptr<T>() : nullptr;
  call.displacement = u.defined() ? u.const_data_ptr<T>() : nullptr;
  call.out = out.mutable_data_ptr<T>();
  if (call.batch > 0) Backend::field(call, out);
}

template <class Backend>
Tensor run_field(Field field, const Tensor& positions, const Tensor& direction,
                 at::TensorList material, at::TensorList plan, const StepOfField& step = {}) {
  check_positions(positions, "positions");
  if (direction.defined()) check_state(direction, positions, "direction", "m");
  const bool per_element = field == Field::element_energy || field == Field::element_energy_product;
  const Tensor& stiffness = array_of(material, "stiffness");
  TORCH_CHECK_VALUE(stiffness.dim() >= 1, "stiffness must be [tet] or [batch, tet] (Pa), got ",
                    describe(stiffness));
  std::vector<std::int64_t> shape = positions.sizes().vec();
  if (per_element) shape = {positions.size(0), stiffness.size(-1)};
  if (field == Field::lame_product) shape = {positions.size(0), stiffness.size(-1), 2};
  const Tensor out = at::empty(shape, positions.options());
  if (positions.scalar_type() == at::kFloat) {
    field_typed<Backend, float>(field, positions, direction, material, plan, out, {}, {}, step);
  } else {
    field_typed<Backend, double>(field, positions, direction, material, plan, out, {}, {}, step);
  }
  return out;
}

// Elastic energy of every environment [batch].
template <class Backend>
Tensor effect_energy(const Tensor& positions, at::TensorList material, at::TensorList plan) {
  check_positions(positions, "positions");
  Tensor tets;
  if constexpr (!Backend::sums_tets) {
    tets = run_field<Backend>(Field::element_energy, positions, {}, material, plan).sum(-1);
    if (!Backend::has_stencils(plan)) return tets;
  }
  const Tensor out = at::zeros({positions.size(0)}, positions.options());
  if (positions.scalar_type() == at::kFloat) {
    field_typed<Backend, float>(Field::effect_energy, positions, {}, material, plan, out);
  } else {
    field_typed<Backend, double>(Field::effect_energy, positions, {}, material, plan, out);
  }
  return tets.defined() ? tets + out : out;
}

// The place of Poisson's ratio in stencil_products.
constexpr std::size_t poisson_product = 1 + place_in_material("poisson") - material_arrays;

// What stencils add to the derivatives by the stiffness and by each array of the effects, [batch, rows] or [batch, rows,
// width]: of the gradient's product with a direction, or else of the energy.
template <class Backend>
std::vector<Tensor> stencil_products(Field field, const Tensor& positions, const Tensor& along,
                                     at::TensorList material, at::TensorList plan,
                                     const StepOfField& step = {},
                                     const Tensor& by_positions = {}) {
  std::vector<Tensor> products;
  const auto add = [&](std::size_t place, int width) {
    std::vector<std::int64_t> shape =
        material[place]
            .sizes()
            .slice(std::max<std::int64_t>(0, material[place].dim() - (width > 1 ? 2 : 1)))
            .vec();
    shape.insert(shape.begin(), positions.size(0));
    products.push_back(at::zeros(shape, positions.options()));
  };
  add(place_in_material("stiffness"), 1);
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) \
  if (material.size() > material_arrays) add(place_in_material(#name), width);
#include "views/material.def"
#undef X
  const Tensor out = by_positions.defined() ? by_positions : at::empty({0}, positions.options());
  if (positions.scalar_type() == at::kFloat) {
    field_typed<Backend, float>(field, positions, along, material, plan, out, {}, products, step);
  } else {
    field_typed<Backend, double>(field, positions, along, material, plan, out, {}, products, step);
  }
  return products;
}

// Derivatives by Young's modulus and Poisson's ratio of every tetrahedron [batch, tets, 2], from its own energy and
// that of stencils that read them: of the gradient's product with a direction, or else of the energy.
template <class Backend>
Tensor lame_product(const Tensor& positions, const OptionalTensor& direction,
                    at::TensorList material, at::TensorList plan) {
  TORCH_CHECK_VALUE(has_poisson(material),
                    "material.poisson must be [tets] or [batch, tets] for "
                    "the derivatives by it, got none");
  const Tensor along = direction.value_or(Tensor());
  const Tensor found = run_field<Backend>(Field::lame_product, positions, along, material, plan);
  if (!stencils_read(plan, "poisson")) return found;
  const std::vector<Tensor> stencils =
      stencil_products<Backend>(Field::effect_products, positions, along, material, plan);
  return found + at::stack({stencils[0], stencils[poisson_product]}, -1);
}

// Derivatives by each array of the effects, [batch, rows] or [batch, rows, width]: of the gradient's product with a
// direction, or else of the energy.
template <class Backend>
std::vector<Tensor> effect_products(const Tensor& positions, const OptionalTensor& direction,
                                    at::TensorList material, at::TensorList plan) {
  check_positions(positions, "positions");
  check_material_size(material);
  if (direction) check_state(*direction, positions, "direction", "m");
  const Tensor along = direction.value_or(Tensor());
  std::vector<Tensor> products =
      stencil_products<Backend>(Field::effect_products, positions, along, material, plan);
  if (has_poisson(material)) {
    products[poisson_product] +=
        run_field<Backend>(Field::lame_product, positions, along, material, plan).select(-1, 1);
  }
  products.erase(products.begin());
  return products;
}

// Checks of the ops of energies that a step dissipates.
inline void check_damping(const Tensor& positions, const Tensor& start, double time_step) {
  check_positions(positions, "positions");
  check_state(start, positions, "start", "positions at the start of the step, m");
  CheckSetting::time_step(time_step);
}

// Gradient of the energies that a step of this length dissipates from its start.
template <class Backend>
Tensor damping_gradient(const Tensor& positions, const Tensor& start, at::TensorList material,
                        at::TensorList plan, double time_step) {
  check_damping(positions, start, time_step);
  return run_field<Backend>(Field::damping_gradient, positions, {}, material, plan,
                            {time_step, start});
}

// Derivatives of that gradient's product with a direction: by positions, by start, then in the order of
// stencil_products.
template <class Backend>
std::vector<Tensor> damping_vjp(const Tensor& positions, const Tensor& start,
                                const Tensor& direction, at::TensorList material,
                                at::TensorList plan, double time_step) {
  check_damping(positions, start, time_step);
  check_state(direction, positions, "direction", "m");
  const StepOfField step{time_step, start};
  std::vector<Tensor> found{
      run_field<Backend>(Field::damping_product, positions, direction, material, plan, step),
      run_field<Backend>(Field::damping_start, positions, direction, material, plan, step)};
  for (const Tensor& product : stencil_products<Backend>(Field::damping_products, positions,
                                                         direction, material, plan, step))
    found.push_back(product);
  return found;
}

template <class Backend>
Tensor gradient(const Tensor& positions, at::TensorList material, at::TensorList plan) {
  return run_field<Backend>(Field::gradient, positions, {}, material, plan);
}

template <class Backend>
Tensor hessian_product(const Tensor& positions, const Tensor& direction, at::TensorList material,
                       at::TensorList plan) {
  return run_field<Backend>(Field::hessian_product, positions, direction, material, plan);
}

template <class Backend>
Tensor element_energy(const Tensor& positions, at::TensorList material, at::TensorList plan) {
  return run_field<Backend>(Field::element_energy, positions, {}, material, plan);
}

template <class Backend>
Tensor element_energy_product(const Tensor& positions, const Tensor& direction,
                              at::TensorList material, at::TensorList plan) {
  return run_field<Backend>(Field::element_energy_product, positions, direction, material, plan);
}

template <class Backend, class T>
Tensor material_field(Field field, at::TensorList material, at::TensorList plan, bool weighted,
                      double time_step) {
  typename Backend::template Field<T> call;
  const Tensor& stiffness = array_of(material, "stiffness");
  const Place place{stiffness.device(), "stiffness"};
  call.plan = Backend::template plan_view<T>(plan, place);
  Backend::view_stencils(call, plan, place);
  call.field = field;
  call.weighted = weighted;
  call.per_time = StepOfField{time_step}.per_time<T>();
  const Tensor w = stiffness_of(material, call.plan.tets);
  const std::optional<std::int64_t> own = environments_of(material);
  const bool batched = own.has_value();
  call.batch = own.value_or(1);
  const EffectArrays<T> effects(Backend::stencil_counts(call), call.plan.tets, material, call.batch,
                                place);
  call.effects = effects.view;
  const int32* counts = Backend::stencil_counts(call);
  if (field == Field::stiffness_at_rest && !counts && !has_poisson(material)) return w.clone();
  const std::int64_t rows =
      field == Field::diagonal ? call.plan.vertices : count_elements(call.plan.tets, counts);
  const Tensor out =
      batched ? at::empty({call.batch, rows}, w.options()) : at::empty({rows}, w.options());
  call.stiffness = values_view<T>(w, call.plan.tets, 1, false, call.batch, place, "stiffness",
                                  "Young's modulus [Pa]");
  call.effects.stiffness = call.stiffness;
  call.out = out.mutable_data_ptr<T>();
  if (call.batch > 0) Backend::field(call, out);
  return out;
}

template <class Backend, class T>
Tensor diagonal_typed(at::TensorList material, at::TensorList plan, bool weighted,
                      double time_step) {
  return material_field<Backend, T>(Field::diagonal, material, plan, weighted, time_step);
}

template <class Backend>
Tensor elastic_diagonal(at::TensorList material, at::TensorList plan, bool weighted,
                        double time_step) {
  const Tensor& stiffness = array_of(material, "stiffness");
  check_real(stiffness, "stiffness", "[tets] or [batch, tets] (Pa)");
  return stiffness.scalar_type() == at::kFloat
             ? diagonal_typed<Backend, float>(material, plan, weighted, time_step)
             : diagonal_typed<Backend, double>(material, plan, weighted, time_step);
}

// 2 mu + lambda of every tetrahedron [tets] or [batch, tets], Young's modulus without Poisson's ratio; see
// elements/lame.h.
inline Tensor matrix_stiffness(at::TensorList material) {
  const Tensor& youngs = array_of(material, "stiffness");
  if (!has_poisson(material)) return youngs.clone();
  const Tensor& poisson = array_of(material, "poisson");
  const Tensor twice_mu = youngs / (1 + poisson);
  return twice_mu + twice_mu * (poisson / (1 - 2 * poisson));
}

// Stiffness of every element at rest, as a preconditioner takes it, [elements] or [batch, elements]: that of
// tetrahedra [Pa], then that of stencils kind by kind.
template <class Backend>
Tensor stiffness_at_rest(at::TensorList material, at::TensorList plan, double time_step) {
  const Tensor& stiffness = array_of(material, "stiffness");
  check_real(stiffness, "stiffness", "[tets] or [batch, tets] (Pa)");
  if (material.size() == material_arrays) return stiffness.clone();
  if (!Backend::has_stencils(plan)) return matrix_stiffness(material);
  const Field field = Field::stiffness_at_rest;
  return stiffness.scalar_type() == at::kFloat
             ? material_field<Backend, float>(field, material, plan, false, time_step)
             : material_field<Backend, double>(field, material, plan, false, time_step);
}

}  // namespace pd
