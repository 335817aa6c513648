// The op of the adjoint of a step with contact between bodies: see contact/pairs/curvature.h and solver/adjoint/pair_rows.h.
#pragma once
#include "binding/adjoint_ops.h"
#include "binding/contact_ops.h"
#include "binding/rigid_adjoint.h"
#include "solver/adjoint/pair_views.h"

#include <cstdint>
#include <limits>
#include <tuple>
#include <vector>

namespace pd {

// What an adjoint reads of pairs, before the arrays of contact.
enum LoadedPairsTensor : int {
  pairs_before,
  pairs_after,
  pairs_poses_before,
  pairs_poses_after,
  pairs_poses_free,
  pairs_keys,
  pairs_forces,
  pairs_contact
};

// Of a Backend that counts loaded pairs by `most_loaded(forces)`, and refuses more than it takes by `check_pairs`.
template <class Backend, class T>
LoadedPairs<T> loaded_pairs_view(at::TensorList pairs, std::int64_t batch, std::int64_t nodes,
                                 const Place& place) {
  constexpr int arrays = int(pairs_contact) + int(contact_array_count);
  TORCH_CHECK_VALUE(pairs.size() == arrays, "pairs must have ", arrays, " arrays, got ",
                    pairs.size());
  LoadedPairs<T> view;
  // colliders with a mass are two vertices more of the system
  const bool masses = pairs[int(pairs_contact) + int(contact_rigid)].numel() > 0;
  const std::int64_t vertices =
      nodes - (masses ? 2 * pairs[pairs_poses_after].size(1) : std::int64_t(0));
  view.plan = contact_plan_view<T>(pairs.slice(pairs_contact), batch, vertices, place);
  const auto check = [&](LoadedPairsTensor which, at::ScalarType type, at::IntArrayRef shape,
                         const char* meaning) {
    const Tensor& tensor = pairs[which];
    check_storage(tensor, type, place, "pairs", meaning);
    TORCH_CHECK_VALUE(tensor.sizes() == shape, "pairs must have ", shape, " (", meaning, "), got ",
                      describe(tensor));
  };
  const auto reals = [&](LoadedPairsTensor which, at::IntArrayRef shape, const char* meaning) {
    check(which, scalar_type<T>, shape, meaning);
    return pairs[which].const_data_ptr<T>();
  };
  const std::int64_t c = view.plan.colliders, m = view.plan.capacity;
  view.before = reals(pairs_before, {batch, vertices, 3}, "positions before the step, m");
  view.after = reals(pairs_after, {batch, vertices, 3}, "positions after it, m");
  view.poses_before = reals(pairs_poses_before, {batch, c, 7}, "of colliders before the step");
  view.poses_after = reals(pairs_poses_after, {batch, c, 7}, "of colliders after it");
  view.poses_free = reals(pairs_poses_free, {batch, c, 7}, "of colliders in nobody's way");
  TORCH_CHECK_VALUE(!masses || pairs[int(pairs_contact) + int(contact_rigid)].size(0) == batch * c,
                    "contact must have masses of ", batch * c, " colliders or of none, got ",
                    describe(pairs[int(pairs_contact) + int(contact_rigid)]));
  check(pairs_keys, at::kLong, {batch, m}, "pairs with forces");
  view.keys = pairs[pairs_keys].const_data_ptr<std::int64_t>();
  view.forces = reals(pairs_forces, {batch, m, 4}, "N");
  view.most = Backend::most_loaded(pairs[pairs_forces]);
  Backend::check_pairs(view);
  return view;
}

// Gradients by the places of bodies at the end and at the start, by the poses of colliders then, by the friction of bodies,
// by the thickness, and by the free motion and the rows of colliders with a mass.
struct PairTensors {
  Tensor end, start, poses_end, poses_start, friction, thickness, poses_free, rigid;
};

struct SolvedAdjoint {
  Tensor right, inertia, inverse;
  OptionalTensor projector, sliding;
  Tensor multiplier, elastic;
};

template <class Backend, class T>
PairTensors pair_gradients_typed(const SolvedAdjoint& s, at::TensorList pairs,
                                 at::TensorList plan) {
  PairGradientsCall<T> call;
  const Place place{s.multiplier.device()};
  const auto solids = Backend::template plan_view<T>(plan, place);
  call.vertex_order = solids.vertex_order;
  call.vertices = solids.vertices;
  call.batch = s.multiplier.size(0);
  const std::int64_t b = call.batch;
  call.pairs = loaded_pairs_view<Backend, T>(pairs, b, call.vertices, place);
  const std::int64_t c = call.pairs.plan.colliders, q = call.pairs.plan.bodies,
                     vertices = call.pairs.plan.body_vertices,
                     masses = call.pairs.plan.rigid ? c : 0;
  std::vector<Tensor> kept;
  const auto keep = [&](const Tensor& tensor) {
    kept.push_back(tensor.contiguous());
    return kept.back().template const_data_ptr<T>();
  };
  const auto rows = [&](const Tensor& values) {
    return Values<T>{keep(values), values.size(0) == 1 ? 0 : values.size(1)};
  };
  call.inertia = rows(s.inertia);
  call.inverse = rows(s.inverse);
  call.right = keep(s.right);
  call.multiplier = keep(s.multiplier);
  call.elastic = keep(s.elastic);
  call.projector = s.projector ? keep(*s.projector) : nullptr;
  call.sliding = s.sliding ? keep(*s.sliding) : nullptr;
  const auto made = [&](at::IntArrayRef shape) { return at::zeros(shape, s.multiplier.options()); };
  const PairTensors out{made({b, vertices, 3}), made({b, vertices, 3}),
                        made({b, c, 7}),        made({b, c, 7}),
                        made({b, q, q}),        made({b}),
                        made({b, c, 7}),        made({b, masses, rigid_numbers})};
  call.out = {out.end.mutable_data_ptr<T>(),        out.start.mutable_data_ptr<T>(),
              out.poses_end.mutable_data_ptr<T>(),  out.poses_start.mutable_data_ptr<T>(),
              out.poses_free.mutable_data_ptr<T>(), out.rigid.mutable_data_ptr<T>(),
              out.friction.mutable_data_ptr<T>(),   out.thickness.mutable_data_ptr<T>()};
  if (b > 0) Backend::pair_gradients(call, s.multiplier);
  return out;
}

// Whether bodies keep a vertex of a hard pin from its target [batch, vertices, 1].
inline Tensor held_back_pins(const AdjointTensors& t) {
  constexpr int vertex_order = 1, pin_vertex = 2;  // of every plan
  const Tensor pins = t.plan[vertex_order].index_select(0, t.plan[pin_vertex]).to(at::kLong);
  const Tensor &springs = t.material[place_in_material("pin_stiffness")],
               &targets = t.material[place_in_material("pin_targets")];
  const Tensor at = t.after.index_select(1, pins);
  const double eps = t.after.scalar_type() == at::kFloat ? std::numeric_limits<float>::epsilon()
                                                         : std::numeric_limits<double>::epsilon();
  const Tensor far = (at - targets).abs().gt(64 * eps * (at.abs() + targets.abs())).any(-1);
  const Tensor held = far.logical_and(springs.isinf()).to(at::kInt);
  const Tensor none = at::zeros({t.after.size(0), t.after.size(1)}, held.options());
  return none.index_add(1, pins, held.expand({t.after.size(0), -1})).gt(0).unsqueeze(-1);
}

// The system of a step with its colliders, whose vertices are last, and a step with as many.
struct WideSystem {
  Tensor right, inertia, inverse;
  OptionalTensor projector, sliding;
  Tensor after, positions;
  std::vector<Tensor> plan;

  void widen(const RigidSystem& rigid) {
    const std::int64_t b = after.size(0), more = rigid.right.size(1);
    const auto add = [](const Tensor& own, const Tensor& added) {
      return at::cat({own, added}, 1);
    };
    right = add(right, rigid.right);
    inertia = add(inertia.expand({b, -1}), rigid.inertia);
    inverse = add(inverse.expand({b, -1}), rigid.inverse);
    if (projector) {
      const at::TensorOptions options = right.options();
      projector = add(*projector, at::eye(3, options).expand({b, more, 3, 3}));
      sliding = add(*sliding, at::zeros({b, more, slide_count, 3}, options));
    }
    after = add(after, at::zeros_like(rigid.right));
    positions = add(positions, at::zeros_like(rigid.right));
    plan = plan_with_more(plan, more, after.is_cuda());
  }
};

// Gradients for positions, velocities and forces [batch, vertices, 3], for the poses of colliders at the end and at the
// start [batch, colliders, 7], for the friction of bodies, the thickness of contact and the masses of colliders, then for
// the wanted arrays of the material. `history`: poses before and after the step, keys and forces of pairs after it;
// `pushes`: forces between bodies [batch, all vertices, 3]. An environment that was taken back passes gradients on to its
// state. What bodies hold back from its target has no gradient.
template <class Backend>
std::vector<Tensor> contact_step_vjp(const Tensor& grad_positions, const Tensor& grad_velocities,
                                     const Tensor& grad_poses, const Tensor& after,
                                     const Tensor& positions, const Tensor& velocities,
                                     const OptionalTensor& forces, const Tensor& poses,
                                     at::TensorList history, const Tensor& pushes,
                                     const Tensor& taken_back, at::TensorList given,
                                     at::TensorList plan, at::TensorList contact, double time_step,
                                     const Wanted& wanted) {
  std::vector<Tensor> material;
  for (const Tensor& array : given) material.push_back(array.contiguous());
  check_wanted(wanted, material.size(), "contact_step_vjp");
  TORCH_CHECK_VALUE(history.size() == 4,
                    "history must be poses before and after the step, keys and forces, got ",
                    history.size(), " arrays");
  // in the precision of the step, also where autocast asks for less
  const c10::impl::ExcludeDispatchKeyGuard plainly(c10::autocast_dispatch_keyset);
  const Tensor back = taken_back.view({-1, 1, 1});
  const Tensor grad_x = at::where(back, 0.0, grad_positions),
               grad_v = at::where(back, 0.0, grad_velocities);
  const AdjointTensors t{grad_x,    grad_v,     after,
                         positions, velocities, forces,
                         material,  plan,       pushes.narrow(1, 0, after.size(1))};
  check_solved_step(t, time_step);
  const bool is_float = after.scalar_type() == at::kFloat;
  const auto [right, inertia, inverse, projector, stuck, sliding] =
      is_float ? adjoint_system_typed<Backend, float>(t, time_step)
               : adjoint_system_typed<Backend, double>(t, time_step);
  const bool touching = projector.size(0) > 0;
  const OptionalTensor free = touching ? OptionalTensor(projector) : OptionalTensor();
  const OptionalTensor slips = touching ? OptionalTensor(sliding) : OptionalTensor();
  std::vector<Tensor> pairs{positions.contiguous(), after.contiguous()};
  for (const Tensor& array : {history[0], history[1], poses, history[2], history[3]})
    pairs.push_back(array.contiguous());
  pairs.insert(pairs.end(), contact.begin(), contact.end());
  WideSystem all{right, inertia, inverse, free, slips, after, positions, plan.vec()};
  const std::int64_t b = after.size(0), vertices = after.size(1), c = poses.size(1);
  const bool masses = contact[contact_rigid].numel() > 0;
  if (masses)
    all.widen({contact[contact_rigid].view({b, c, rigid_numbers}), poses, history[1],
               at::where(back, 0.0, grad_poses), back.view({-1, 1})});
  const AdjointTensors wide{grad_x,     grad_v, all.after, all.positions,
                            velocities, forces, material,  all.plan};
  const auto [solutions, error] = solve<Backend>(
      wide, {all.right, all.inertia, all.inverse, all.projector, all.sliding, pairs}, time_step);
  const Tensor solution = solutions.narrow(1, 0, vertices).contiguous();
  Tensor elastic = elastic_product(t, solution, time_step);
  const SolvedAdjoint solved{
      all.right,
      all.inertia,
      all.inverse,
      all.projector,
      all.sliding,
      solutions,
      masses ? at::cat({elastic, at::zeros({b, 2 * c, 3}, elastic.options())}, 1) : elastic};
  const PairTensors own = is_float ? pair_gradients_typed<Backend, float>(solved, pairs, all.plan)
                                   : pair_gradients_typed<Backend, double>(solved, pairs, all.plan);
  elastic = at::where(held_back_pins(t), grad_x + grad_v / time_step, elastic + own.end);
  HeldTerms held_terms;
  if (touching) held_terms = {grad_x, elastic, projector, stuck, sliding};
  auto [x, v, multiplier] = adjoint_result<Backend>(
      solution, error, grad_v, material, held_terms.grad_positions, held_terms.elastic,
      held_terms.projector, held_terms.stuck, held_terms.sliding, time_step);
  const DampingProducts damping(t, multiplier, time_step);
  if (damping.some()) x = x - damping.by_start();
  x = x - own.start;
  const LossMask loss_mask(grad_x, masses ? at::cat({grad_v, all.right}, 1) : grad_v);
  const auto masked = [&](const Tensor& each) { return loss_mask.masked(each); };
  const Tensor reached = poses.eq(history[1]).all(-1, true).logical_and(back.logical_not());
  std::vector<Tensor> found{
      masked(x) + at::where(back, grad_positions, 0.0),
      masked(v) + at::where(back, grad_velocities, 0.0),
      masked(multiplier),
      at::where(reached, masked(own.poses_end) + grad_poses, masked(own.poses_free)),
      masked(own.poses_start) + at::where(back, grad_poses, 0.0),
      contact[contact_friction].dim() == 3 ? masked(own.friction) : masked(own.friction).sum(0),
      masked(own.thickness).sum(0, true),
      masked(own.rigid).view({-1, rigid_numbers}),
  };
  const MaterialGradients gradients(
      t, multiplier, elastic, damping,
      [&, l = multiplier](const Tensor& product) {
        const auto wants = [&](const char* name) {
          return !wanted || wanted->get(place_in_material(name));
        };
        return gradients_for_contacts<Backend>(t, l, product, time_step,
                                               {wants("planes"), wants("spheres")});
      },
      &sum_vertices<Backend>, loss_mask, time_step);
  for (std::size_t i = 0; i < material.size(); ++i) {
    if (!wanted || wanted->get(i)) found.push_back(gradients.of(i));
  }
  return found;
}

template <class Backend>
void register_contact_adjoint(torch::Library& m) {
  m.impl("contact_conjugate", &contact_conjugate<Backend>);
  m.impl("contact_step_vjp", &contact_step_vjp<Backend>);
}

}  // namespace pd
