// The ops of the motion of colliders with a mass: free in a step, after it, and their derivatives.
#pragma once
#include "binding/ops.h"
#include "solver/contact/rigid_motion.h"

#include <optional>
#include <vector>

namespace pd {

// Arrays by which a motion is found, null for zeros, and their names. The first one has the batch and the colliders.
struct MotionInputs {
  std::vector<OptionalTensor> arrays;
  const char* const* names;

  const Tensor& first() const { return *arrays[0]; }
};

template <class Motion, class T>
RigidMotionCall<T> motion_call(const MotionInputs& inputs, double time_step) {
  const Tensor& first = inputs.first();
  RigidMotionCall<T> call;
  call.batch = first.size(0);
  call.colliders = first.size(1);
  call.time_step = time_step;
  for (int a = 0; a < Motion::arrays; ++a) {
    if (!inputs.arrays[a]) continue;
    const Tensor wide = inputs.arrays[a]->expand({call.batch, call.colliders, Motion::width(a)});
    call.in[a] = {wide.const_data_ptr<T>(), wide.stride(0), wide.stride(1), wide.stride(2)};
  }
  return call;
}

// Each array suits [batch, colliders, numbers].
template <class Motion>
void check_motion(const MotionInputs& inputs, double time_step) {
  const Tensor& first = inputs.first();
  check_real(first, inputs.names[0], "[batch, colliders, 7]");
  TORCH_CHECK_VALUE(first.dim() == 3, inputs.names[0], " must be [batch, colliders, ",
                    Motion::width(0), "], got ", describe(first));
  TORCH_CHECK_VALUE(time_step > 0, "time_step must be positive [s], got ", time_step);
  for (int a = 0; a < Motion::arrays; ++a) {
    if (!inputs.arrays[a]) continue;
    const Tensor& t = *inputs.arrays[a];
    bool fits = t.scalar_type() == first.scalar_type() && t.device() == first.device() &&
                t.dim() >= 1 && t.dim() <= 3 && t.size(-1) == Motion::width(a);
    for (std::int64_t d = 1; fits && d < t.dim(); ++d)
      fits = t.size(-1 - d) == 1 || t.size(-1 - d) == first.size(2 - d);
    TORCH_CHECK_VALUE(fits, inputs.names[a], " must be like ", inputs.names[0], " and expand to [",
                      first.size(0), ", ", first.size(1), ", ", Motion::width(a), "], got ",
                      describe(t));
  }
}

template <class Backend, class Motion, class T>
void find_motion_typed(const MotionInputs& inputs, double time_step,
                       const std::vector<Tensor>& results) {
  RigidMotionCall<T> call = motion_call<Motion, T>(inputs, time_step);
  for (int r = 0; r < Motion::results; ++r) call.out[r] = results[r].mutable_data_ptr<T>();
  if (call.batch * call.colliders > 0) Backend::template find_motion<Motion>(call, inputs.first());
}

template <class Backend, class Motion>
std::vector<Tensor> find_motion_of(const MotionInputs& inputs, double time_step) {
  check_motion<Motion>(inputs, time_step);
  const Tensor& first = inputs.first();
  std::vector<Tensor> results;
  for (int r = 0; r < Motion::results; ++r) {
    results.push_back(
        at::empty({first.size(0), first.size(1), Motion::result_width(r)}, first.options()));
  }
  if (first.scalar_type() == at::kFloat) {
    find_motion_typed<Backend, Motion, float>(inputs, time_step, results);
  } else {
    find_motion_typed<Backend, Motion, double>(inputs, time_step, results);
  }
  return results;
}

template <class Backend, class Motion, class T>
void motion_vjp_typed(const MotionInputs& inputs, double time_step,
                      const std::vector<Tensor>& gradients, const Tensor& out) {
  RigidMotionCall<T> call = motion_call<Motion, T>(inputs, time_step);
  for (int r = 0; r < Motion::results; ++r) call.gradient[r] = gradients[r].const_data_ptr<T>();
  call.out[0] = out.mutable_data_ptr<T>();
  if (call.batch * call.colliders > 0)
    Backend::template differentiate_motion<Motion>(call, inputs.first());
}

// [batch, colliders, all numbers that are read]
template <class Backend, class Motion>
Tensor motion_vjp_of(const MotionInputs& inputs, double time_step,
                     const std::vector<Tensor>& gradients) {
  check_motion<Motion>(inputs, time_step);
  const Tensor& first = inputs.first();
  std::vector<Tensor> dense;
  for (int r = 0; r < Motion::results; ++r) {
    const Tensor& g = gradients[r];
    const std::int64_t width = Motion::result_width(r);
    TORCH_CHECK_VALUE(g.sizes() == at::IntArrayRef({first.size(0), first.size(1), width}) &&
                          g.scalar_type() == first.scalar_type() && g.device() == first.device(),
                      "gradients must be [", first.size(0), ", ", first.size(1), ", ", width,
                      "] like ", inputs.names[0], ", got ", describe(g));
    dense.push_back(g.contiguous());
  }
  const Tensor out = at::empty({first.size(0), first.size(1), Motion::inputs}, first.options());
  if (first.scalar_type() == at::kFloat) {
    motion_vjp_typed<Backend, Motion, float>(inputs, time_step, dense, out);
  } else {
    motion_vjp_typed<Backend, Motion, double>(inputs, time_step, dense, out);
  }
  return out;
}

inline constexpr const char* free_motion_names[] = {"poses", "motion", "wrenches", "gravity",
                                                    "bodies"};
inline constexpr const char* motion_after_names[] = {"before", "goal",  "rates",
                                                     "rows",   "poses", "bodies"};

template <class Backend>
std::tuple<Tensor, Tensor, Tensor> free_motion(const Tensor& poses, const Tensor& motion,
                                               const OptionalTensor& wrenches,
                                               const Tensor& gravity, const Tensor& bodies,
                                               double time_step) {
  const std::vector<Tensor> found = find_motion_of<Backend, FreeMotionOfRigid>(
      {{poses, motion, wrenches, gravity, bodies}, free_motion_names}, time_step);
  return {found[0], found[1], found[2]};
}

template <class Backend>
Tensor free_motion_vjp(const Tensor& grad_poses, const Tensor& grad_rates, const Tensor& grad_rows,
                       const Tensor& poses, const Tensor& motion, const OptionalTensor& wrenches,
                       const Tensor& gravity, const Tensor& bodies, double time_step) {
  return motion_vjp_of<Backend, FreeMotionOfRigid>(
      {{poses, motion, wrenches, gravity, bodies}, free_motion_names}, time_step,
      {grad_poses, grad_rates, grad_rows});
}

template <class Backend>
Tensor motion_after(const Tensor& before, const Tensor& goal, const Tensor& rates,
                    const Tensor& rows, const Tensor& poses, const Tensor& bodies,
                    double time_step) {
  return find_motion_of<Backend, MotionAfterStep>(
      {{before, goal, rates, rows, poses, bodies}, motion_after_names}, time_step)[0];
}

template <class Backend>
Tensor motion_after_vjp(const Tensor& grad, const Tensor& before, const Tensor& goal,
                        const Tensor& rates, const Tensor& rows, const Tensor& poses,
                        const Tensor& bodies, double time_step) {
  return motion_vjp_of<Backend, MotionAfterStep>(
      {{before, goal, rates, rows, poses, bodies}, motion_after_names}, time_step, {grad});
}

template <class Backend>
void register_rigid_motion(torch::Library& m) {
  m.impl("free_motion", &free_motion<Backend>);
  m.impl("free_motion_vjp", &free_motion_vjp<Backend>);
  m.impl("motion_after", &motion_after<Backend>);
  m.impl("motion_after_vjp", &motion_after_vjp<Backend>);
}

}  // namespace pd
