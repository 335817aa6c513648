// The op of a step with contact between bodies.
#pragma once
#include "binding/ops.h"
#include "contact/views.h"

#include <cstdint>
#include <tuple>
#include <vector>

namespace pd {

// Positions, velocities, info; then numbers of the contact, how far colliders were held back, the history, and forces of
// contact on every vertex.
using ContactOutputs =
    std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// The arrays of a contact plan, in their order.
enum ContactArray : int {
  contact_sizes,
  contact_triangle,
  contact_edge,
  contact_point,
  contact_body,
  contact_collider,
  contact_touches_itself,
  contact_leaves,
  contact_cluster_body,
  contact_starts,
  contact_rest_key,
  contact_rest_thickness,
  contact_rest,
  contact_rest_apart,
  contact_local,
  contact_cell,
  contact_friction,
  contact_rigid,
  contact_thickness,
  contact_array_count
};

// Counts in contact.sizes.
enum ContactSize : int {
  size_bodies,
  size_colliders,
  size_capacity,
  size_point_clusters,
  size_edge_clusters,
  size_can_be_free,
  contact_size_count
};

template <class T>
ContactPlan<T> contact_plan_view(at::TensorList arrays, std::int64_t batch,
                                 std::int64_t body_vertices, const Place& place) {
  TORCH_CHECK_VALUE(arrays.size() == contact_array_count, "contact must have ",
                    int(contact_array_count), " arrays, got ", arrays.size(),
                    "; compile the scene again");
  const int32* sizes = sizes_view(arrays[contact_sizes], contact_size_count);
  ContactPlan<T> plan;
  plan.bodies = sizes[size_bodies];
  plan.colliders = sizes[size_colliders];
  plan.capacity = sizes[size_capacity];
  plan.point_clusters = sizes[size_point_clusters];
  plan.edge_clusters = sizes[size_edge_clusters];
  plan.can_be_free = sizes[size_can_be_free] != 0;
  const auto array = [&](ContactArray which, at::ScalarType type, std::int64_t rows,
                         std::int64_t width, const char* meaning) -> const void* {
    check_array(arrays[which], type, rows, width, place, "contact", meaning);
    return arrays[which].const_data_ptr();
  };
  const auto ints = [&](ContactArray which, std::int64_t rows, std::int64_t width,
                        const char* meaning) {
    return static_cast<const int32*>(array(which, at::kInt, rows, width, meaning));
  };
  const auto reals = [&](ContactArray which, std::int64_t rows, std::int64_t width,
                         const char* meaning) {
    return static_cast<const T*>(array(which, scalar_type<T>, rows, width, meaning));
  };
  const auto rows_of_array = [&](ContactArray which) {
    return arrays[which].dim() ? arrays[which].size(0) : 0;
  };
  plan.vertices = int(rows_of_array(contact_body));
  plan.body_vertices = int(body_vertices);
  plan.triangles = int(rows_of_array(contact_triangle));
  plan.edges = int(rows_of_array(contact_edge));
  plan.points = int(rows_of_array(contact_point));
  plan.rest_pairs = rows_of_array(contact_rest_key);
  plan.triangle = ints(contact_triangle, plan.triangles, 3, "vertices of triangles");
  plan.edge = ints(contact_edge, plan.edges, 2, "vertices of edges");
  plan.point = ints(contact_point, plan.points, 1, "vertices of surfaces");
  plan.body = ints(contact_body, plan.vertices, 1, "body of each vertex");
  plan.collider = ints(contact_collider, plan.vertices, 1, "collider of each vertex");
  plan.touches_itself =
      ints(contact_touches_itself, plan.bodies, 1, "whether bodies touch themselves");
  plan.clusters = int(rows_of_array(contact_cluster_body));
  plan.leaves = ints(contact_leaves, std::int64_t(4) * plan.clusters, 32, "sides of clusters");
  plan.cluster_body = ints(contact_cluster_body, plan.clusters, 1, "body of each cluster");
  plan.body_start =
      ints(contact_starts, 2, plan.bodies + 1, "first vertices of bodies, all and of surfaces");
  plan.surface_start = plan.body_start + plan.bodies + 1;
  plan.rest_key = static_cast<const std::int64_t*>(array(
      contact_rest_key, at::kLong, plan.rest_pairs, 1, "keys of pairs that are close at rest"));
  plan.rest_thickness = reals(contact_rest_thickness, plan.rest_pairs, 1, "their thickness [m]");
  plan.rest = reals(contact_rest, body_vertices, 3, "vertices about the middles of bodies [m]");
  plan.rest_apart = reals(contact_rest_apart, plan.bodies, 1, "least distance of parts [m]");
  plan.local =
      reals(contact_local, plan.vertices - plan.body_vertices, 3, "points of colliders [m]");
  plan.cell = reals(contact_cell, plan.vertices, 1, "mean edge of each vertex's body [m]");
  const Tensor& friction = arrays[contact_friction];
  const std::int64_t q = plan.bodies;
  check_storage(friction, scalar_type<T>, place, "contact", "friction of pairs of bodies");
  TORCH_CHECK_VALUE(friction.sizes() == at::IntArrayRef({q, q}) ||
                        friction.sizes() == at::IntArrayRef({batch, q, q}),
                    "contact_friction must be [", q, ", ", q, "] or [", batch, ", ", q, ", ", q,
                    "], of every pair of bodies, got ", describe(friction),
                    "; sim.rest_state(N) makes a state of N environments");
  plan.friction = friction.const_data_ptr<T>();
  plan.friction_stride = friction.dim() == 3 ? q * q : 0;
  const std::int64_t rigid = rows_of_array(contact_rigid);
  const T* const numbers = reals(contact_rigid, rigid, rigid_numbers, "masses of colliders");
  plan.rigid = rigid > 0 ? numbers : nullptr;
  // a number of the host, as sizes
  check_array(arrays[contact_thickness], scalar_type<T>, 1, 1, {at::kCPU, "every plan's thickness"},
              "contact", "thickness [m]");
  plan.thickness = *arrays[contact_thickness].const_data_ptr<T>();
  TORCH_CHECK_VALUE(plan.thickness > 0, "contact_thickness must be positive [m], got ",
                    plan.thickness);
  return plan;
}

template <class Backend, class T>
ContactOutputs contact_step_typed(const StepTensors& t, const Tensor& poses, at::TensorList history,
                                  at::TensorList contact, const Settings& settings, bool report) {
  typename Backend::template Step<T> call;
  const Place place{t.positions.device()};
  call.plan = Backend::template plan_view<T>(t.plan, place);
  Backend::view_stencils(call, t.plan, place);
  call.batch = t.positions.size(0);
  check_vertices(t.positions, call.plan.vertices);
  TORCH_CHECK_VALUE(!settings.multilevel(),
                    "contact_step takes Chebyshev and Jacobi, got another solver");
  call.material = material_view<T>(call.plan, t.material, call.batch, place);
  call.effects =
      effects_view<T>(Backend::stencil_counts(call), call.plan.tets, t.material, call.batch, place);
  call.effects.stiffness = call.material.stiffness;
  check_tets(t.material[0], call.plan.tets);
  call.settings = settings;
  const Tensor x = t.positions.contiguous(), v = t.velocities.contiguous();
  const Tensor f = t.forces ? t.forces->contiguous() : Tensor();
  call.positions = x.const_data_ptr<T>();
  call.velocities = v.const_data_ptr<T>();
  call.forces = f.defined() ? f.const_data_ptr<T>() : nullptr;
  call.out_positions = t.out_positions.mutable_data_ptr<T>();
  call.out_velocities = t.out_velocities.mutable_data_ptr<T>();
  call.info = t.info.mutable_data_ptr<double>();

  ContactCall<T> of;
  of.plan = contact_plan_view<T>(contact, call.batch, call.plan.vertices, place);
  const std::int64_t b = call.batch, c = of.plan.colliders, m = of.plan.capacity;
  const at::ScalarType real = scalar_type<T>;
  const auto check = [&](const Tensor& tensor, at::ScalarType type, at::IntArrayRef shape,
                         const char* name, const char* meaning) {
    check_storage(tensor, type, place, name, meaning);
    TORCH_CHECK_VALUE(tensor.sizes() == shape, name, " must be ", shape, " (", meaning, "), got ",
                      describe(tensor));
  };
  TORCH_CHECK_VALUE(history.size() == 3, "history must be poses, keys and forces, got ",
                    history.size(), " arrays");
  check(poses, real, {b, c, 7}, "poses", "of colliders at the step's end");
  check(history[0], real, {b, c, 7}, "history.poses", "actual poses of colliders");
  check(history[1], at::kLong, {b, m}, "history.keys", "pairs with forces");
  check(history[2], real, {b, m, 4}, "history.forces", "N");
  const std::int64_t rigid = contact[contact_rigid].size(0);
  TORCH_CHECK_VALUE(rigid == 0 || rigid == b * c, "contact must have masses of ", b * c,
                    " colliders or of none, got ", rigid, " rows");
  const Tensor info = at::empty({b, contact_info_count}, x.options().dtype(at::kDouble)),
               held = at::empty({b, c}, x.options()),
               next_poses = at::empty({b, c, 7}, x.options()),
               next_keys = at::empty({b, m}, history[1].options()),
               next_forces = at::empty({b, m, 4}, x.options()),
               pushes = at::empty({b, of.plan.vertices, 3}, x.options());
  of.history = {history[0].const_data_ptr<T>(),
                history[1].const_data_ptr<std::int64_t>(),
                history[2].const_data_ptr<T>(),
                next_poses.mutable_data_ptr<T>(),
                next_keys.mutable_data_ptr<std::int64_t>(),
                next_forces.mutable_data_ptr<T>()};
  of.poses = poses.const_data_ptr<T>();
  of.info = info.mutable_data_ptr<double>();
  of.held_back = held.mutable_data_ptr<T>();
  of.forces = pushes.mutable_data_ptr<T>();
  of.report = report;
  if (b > 0) Backend::contact_step(call, of, t.positions);
  return {t.out_positions, t.out_velocities, t.info,      info,  held,
          next_poses,      next_keys,        next_forces, pushes};
}

template <class Backend>
ContactOutputs contact_step(const Numbers& n, const Tensor& positions, const Tensor& velocities,
                            const OptionalTensor& forces, const Tensor& poses,
                            at::TensorList history, at::TensorList material, at::TensorList plan,
                            at::TensorList contact) {
  check_positions(positions, "positions");
  check_state(velocities, positions, "velocities", "m/s");
  if (forces) check_state(*forces, positions, "forces", "N");
  const Tensor x = at::empty(positions.sizes(), positions.options()), v = at::empty_like(x);
  const Tensor info = info_for(positions, {});
  const StepTensors tensors{positions, velocities, forces, {}, material, plan, x, v, info};
  const Settings settings = settings_of(n, false, 1, 1);
  const ContactOutputs made =
      positions.scalar_type() == at::kFloat
          ? contact_step_typed<Backend, float>(tensors, poses, history, contact, settings, n.report)
          : contact_step_typed<Backend, double>(tensors, poses, history, contact, settings,
                                                n.report);
  if (n.report) {
    const Tensor &numbers = std::get<3>(made), &pushes = std::get<8>(made);
    report_step<Backend>(tensors, n, &pushes);
    // of bodies, or of colliders where it is larger
    const Tensor residual = numbers.select(1, contact_residual);
    residual.copy_(at::maximum(residual, info.select(1, info_residual)));
  }
  return made;
}

template <class Backend>
void register_contact_ops(torch::Library& m) {
  m.impl("contact_step", unpacked<&contact_step<Backend>>);
}

}  // namespace pd
