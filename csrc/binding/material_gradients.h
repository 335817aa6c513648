// Gradients of a step for the arrays of its material, once its adjoint is solved.
#pragma once
#include "binding/find_op.h"
#include "binding/step_taken.h"
#include "solver/adjoint/contact_gradients.h"
#include "views/vertex_sum.h"

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string_view>
#include <tuple>
#include <utility>
#include <vector>

namespace pd {

// Derivatives of l . (gradient of what a step dissipates), through the dispatcher.
class DampingProducts {
 public:
  DampingProducts(const AdjointTensors& t, const Tensor& multiplier, double time_step) {
    if (!has_damping(t.material)) return;
    static const auto op =
        find_op<std::vector<Tensor>(const Tensor&, const Tensor&, const Tensor&, at::TensorList,
                                    at::TensorList, double)>("torchpd::damping_vjp");
    found_ = op.call(t.after, t.positions, multiplier, t.material, t.plan, time_step);
  }
  bool some() const { return !found_.empty(); }
  const Tensor& by_positions() const { return found_[0]; }
  const Tensor& by_start() const { return found_[1]; }
  // by the stiffness, then by each array of the effects
  const Tensor& by_array(std::size_t number) const { return found_[2 + number]; }

 private:
  std::vector<Tensor> found_;
};

// K l, through the dispatcher, so that its profiler sees it. Damping adds to K.
inline Tensor elastic_product(const AdjointTensors& t, const Tensor& multiplier, double time_step) {
  static const auto op =
      find_op<Tensor(const Tensor&, const Tensor&, at::TensorList, at::TensorList)>(
          "torchpd::hessian_product");
  const Tensor elastic = op.call(t.after, multiplier, t.material, t.plan);
  const DampingProducts damping(t, multiplier, time_step);
  return damping.some() ? elastic + damping.by_positions() : elastic;
}

// Environments that the loss depends on. A NaN environment that the loss leaves out must not spoil shared gradients.
class LossMask {
 public:
  LossMask(const Tensor& grad_positions, const Tensor& grad_velocities) {
    // a single environment shares nothing
    if (grad_positions.size(0) < 2 || grad_positions[0].numel() == 0) return;
    const auto some = [](const Tensor& gradient) { return gradient.ne(0.0).flatten(1).any(1); };
    is_ = some(grad_positions).logical_or_(some(grad_velocities));
  }

  // [batch, ...], 0 in other environments
  Tensor masked(const Tensor& each) const {
    if (!is_.defined()) return each;
    std::vector<std::int64_t> shape(each.dim(), 1);
    shape[0] = -1;
    return at::where(is_.view(shape), each, 0.0);
  }

 private:
  Tensor is_;
};

// Sums [batch, vertices, ...] to [batch, ...]. The order of torch's own sums depends on the batch.
template <class Backend, class T>
Tensor sum_vertices_typed(const Tensor& values) {
  const Tensor from = values.contiguous();
  std::vector<std::int64_t> shape = from.sizes().vec();
  shape.erase(shape.begin() + 1);
  const Tensor out = at::empty(shape, from.options());
  if (out.numel() == 0) return out;
  Backend::vertex_sum(VertexSumCall<T>{from.size(0), from.size(1), out.numel() / from.size(0),
                                       from.const_data_ptr<T>(), out.mutable_data_ptr<T>()},
                      out);
  return out;
}

template <class Backend>
Tensor sum_vertices(const Tensor& values) {
  return values.scalar_type() == at::kFloat ? sum_vertices_typed<Backend, float>(values)
                                            : sum_vertices_typed<Backend, double>(values);
}

// The contacts whose gradients are wanted.
struct WantedContacts {
  bool planes = true, spheres = true;
};

// Gradients for planes [batch, planes, 5] and spheres [batch, spheres, 8], empty if not wanted; `elastic`: K l.
template <class Backend, class T>
std::tuple<Tensor, Tensor> gradients_for_contacts_typed(const AdjointTensors& t,
                                                        const Tensor& multiplier,
                                                        const Tensor& elastic, double time_step,
                                                        WantedContacts wanted) {
  SolvedStep<Backend, T> step(t, time_step);
  ContactGradientsCall<T, typename Backend::template Plan<T>> call{step.call};
  call.multiplier = step.keep(multiplier);
  call.elastic = step.keep(elastic);
  const Material<T>& m = step.call.material;
  const auto of_vertices = [&](std::int64_t count, std::int64_t numbers) {
    return at::empty({step.call.batch, step.call.plan.vertices, count, numbers}, t.after.options());
  };
  const Tensor planes = of_vertices(wanted.planes ? m.planes_count : 0, planes_numbers);
  const Tensor spheres = of_vertices(wanted.spheres ? m.spheres_count : 0, spheres_numbers);
  if (planes.numel() > 0) call.planes = planes.mutable_data_ptr<T>();
  if (spheres.numel() > 0) call.spheres = spheres.mutable_data_ptr<T>();
  if (call.planes || call.spheres) Backend::contact_gradients(call, multiplier);
  return {sum_vertices_typed<Backend, T>(planes), sum_vertices_typed<Backend, T>(spheres)};
}

template <class Backend>
std::tuple<Tensor, Tensor> gradients_for_contacts(const AdjointTensors& t, const Tensor& multiplier,
                                                  const Tensor& elastic, double time_step,
                                                  WantedContacts wanted = {}) {
  return multiplier.scalar_type() == at::kFloat ? gradients_for_contacts_typed<Backend, float>(
                                                      t, multiplier, elastic, time_step, wanted)
                                                : gradients_for_contacts_typed<Backend, double>(
                                                      t, multiplier, elastic, time_step, wanted);
}

// -l . dr/dp of every environment for an array p of the material, from formulas for single environments.
class MaterialGradients {
 public:
  // `elastic`: K l, or undefined if not computed yet; `contacts`: gradients_for_contacts by K l; `sum`: sum_vertices
  using Contacts = std::function<std::tuple<Tensor, Tensor>(const Tensor& elastic)>;
  using Sum = Tensor (*)(const Tensor& values);
  MaterialGradients(const AdjointTensors& t, const Tensor& multiplier, const Tensor& elastic,
                    const DampingProducts& damping, Contacts contacts, Sum sum,
                    const LossMask& loss_mask, double time_step)
      : t_(t),
        multiplier_(multiplier),
        elastic_(elastic),
        damping_products_(damping),
        contacts_(std::move(contacts)),
        sum_(sum),
        loss_mask_(loss_mask),
        h_(time_step) {}

  // gradient of the array at a place; environments that share it get the sum over them
  Tensor of(std::size_t place) const {
    const Tensor& array = t_.material[place];
#define X(name, width, rows, meaning)    \
  if (place == place_in_material(#name)) \
    return reduce(name(), array, (width > 1 ? 1 : 0) + (std::string_view(#rows) != "one"));
#define EFFECT(name, width, rows, meaning) \
  if (place == place_in_material(#name))   \
    return reduce(-of_effects(place - material_arrays), array, width > 1 ? 2 : 1);
#include "views/material.def"
#undef X
    TORCH_INTERNAL_ASSERT(false);
  }

 private:
  Tensor reduce(const Tensor& every, const Tensor& like, std::int64_t own) const {
    const Tensor each = loss_mask_.masked(every);
    return like.dim() == own ? each.sum(0) : each.sum_to_size(like.sizes());
  }

  const Tensor& material(const char* name) const { return t_.material[place_in_material(name)]; }
  Tensor mass() const { return material("masses").unsqueeze(-1); }
  Tensor rate() const { return (t_.after - t_.positions) / h_; }
  Tensor hard() const { return material("pin_stiffness").isinf(); }

  // user's numbers of the pinned vertices
  Tensor pins() const {
    constexpr int vertex_order = 1, pin_vertex = 2;  // of every plan
    return t_.plan[vertex_order].index_select(0, t_.plan[pin_vertex]).to(at::kLong);
  }
  Tensor pinned(const Tensor& field) const { return field.index_select(1, pins()); }

  // K l; one computed earlier may lack the NaN of a failed environment
  Tensor product() const {
    return elastic_.defined() ? elastic_ + 0.0 * multiplier_ : elastic_product(t_, multiplier_, h_);
  }

  // the part that held vertices pass on
  Tensor held_gradient() const { return t_.grad_positions + t_.grad_velocities / h_ - product(); }

  Tensor stiffness() const {
    const Tensor elastic = -of_tets();
    return damping_products_.some() ? elastic - damping_products_.by_array(0) : elastic;
  }

  Tensor of_tets() const {
    if (has_poisson(t_.material)) return of_lame().select(-1, 0);
    static const auto op =
        find_op<Tensor(const Tensor&, const Tensor&, at::TensorList, at::TensorList)>(
            "torchpd::element_energy_product");
    std::vector<Tensor> unit(t_.material.begin(), t_.material.end());
    unit[place_in_material("stiffness")] = at::ones_like(material("stiffness"));
    return op.call(t_.after, multiplier_, unit, t_.plan);
  }

  // by E and nu
  const Tensor& of_lame() const {
    static const auto op =
        find_op<Tensor(const Tensor&, const OptionalTensor&, at::TensorList, at::TensorList)>(
            "torchpd::lame_product");
    if (!of_lame_) of_lame_ = op.call(t_.after, multiplier_, t_.material, t_.plan);
    return *of_lame_;
  }

  Tensor of_effects(std::size_t number) const {
    const Tensor elastic = elastic_effects(number);
    return damping_products_.some() ? elastic + damping_products_.by_array(1 + number) : elastic;
  }

  Tensor elastic_effects(std::size_t number) const {
    if (number + material_arrays == place_in_material("poisson") && has_poisson(t_.material))
      return of_lame().select(-1, 1);
    static const auto op =
        find_op<std::vector<Tensor>(const Tensor&, const OptionalTensor&, at::TensorList,
                                    at::TensorList)>("torchpd::effect_products");
    if (!of_effects_) of_effects_ = op.call(t_.after, multiplier_, t_.material, t_.plan);
    return (*of_effects_)[number];
  }

  Tensor masses() const {
    const Tensor lag = 1 + material("damping").unsqueeze(-1).unsqueeze(-1) * h_;
    const Tensor pull = (lag * rate() - t_.velocities) / h_ - material("gravity").unsqueeze(-2);
    return -(multiplier_ * pull).sum(-1);
  }

  Tensor gravity() const { return sum_(mass() * multiplier_); }

  Tensor damping() const { return -sum_((mass() * multiplier_ * rate()).flatten(1)); }

  Tensor pin_stiffness() const {
    const Tensor stretch = pinned(t_.after) - material("pin_targets");
    return at::where(hard(), 0.0, -(pinned(multiplier_) * stretch).sum(-1));
  }

  // a hard pin takes the gradient of its vertex
  Tensor pin_targets() const {
    const Tensor held = hard().unsqueeze(-1);
    const Tensor springs = at::where(held, 0.0, material("pin_stiffness").unsqueeze(-1));
    return at::where(held, pinned(held_gradient()), springs * pinned(multiplier_));
  }

  Tensor planes() const { return std::get<0>(of_contacts()); }
  Tensor spheres() const { return std::get<1>(of_contacts()); }
  const std::tuple<Tensor, Tensor>& of_contacts() const {
    if (!of_contacts_) of_contacts_ = contacts_(product());
    return *of_contacts_;
  }

  const AdjointTensors& t_;
  const Tensor& multiplier_;
  const Tensor& elastic_;
  const DampingProducts& damping_products_;
  Contacts contacts_;
  Sum sum_;
  const LossMask& loss_mask_;
  double h_;
  mutable std::optional<std::tuple<Tensor, Tensor>> of_contacts_;
  mutable std::optional<Tensor> of_lame_;
  mutable std::optional<std::vector<Tensor>> of_effects_;
};

}  // namespace pd
