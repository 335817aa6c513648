// Deformation gradients and frames, on either device: checks, views, the tasks one after another.
#pragma once
#include "freeform/binding/checks.h"

#include <cmath>
#include <tuple>

namespace pd::freeform {

struct DeformationTensors {
  Constraints constraints;
  Tensor positions, inverse_rest, fallback;
  std::int64_t batch;

  DeformationTensors(const Tensor& x, const Tensor& rest, const OptionalTensor& instead,
                     at::TensorList arrays, double lower, double upper) {
    check_batched(x, 3, "positions", "[batch, points, 3] (m)");
    TORCH_CHECK_VALUE(lower > 0 && lower <= 1 && upper >= 1 && std::isfinite(upper),
                      "lower must lie in (0, 1] and upper must be finite and >= 1, got ", lower,
                      " and ", upper);
    constraints = constraints_view(arrays, {x.device()});
    batch = x.size(0);
    const auto n = constraints.count;
    positions = real_argument(x, x, {batch, constraints.points, 3}, "positions", "m");
    inverse_rest = real_argument(rest, x, {n, 3, 3}, "inverse_rest", "Dm^-1, 1/m");
    if (instead)
      fallback = real_argument(*instead, x, {batch, n, 3, 3}, "fallback",
                               "what takes the place of a collapsed constraint's gradient");
  }

  Tensor empty(at::IntArrayRef sizes) const { return at::empty(sizes, positions.options()); }
};

template <class Backend>
Tensor deformation(const Tensor& positions, const Tensor& inverse_rest,
                   const OptionalTensor& fallback, at::TensorList constraints, double lower,
                   double upper) {
  const DeformationTensors in(positions, inverse_rest, fallback, constraints, lower, upper);
  const Tensor out = in.empty({in.batch, in.constraints.count, 3, 3});
  for_precision(positions, [&](auto real) {
    using T = decltype(real);
    const Deformation<T> task{
        in.constraints,           read<T>(in.positions),
        read<T>(in.inverse_rest), in.fallback.defined() ? read<T>(in.fallback) : nullptr,
        {T(lower), T(upper)},     write<T>(out)};
    Backend::run(task, in.batch * in.constraints.count, positions);
  });
  return out;
}

template <class Backend>
std::tuple<Tensor, Tensor, Tensor> deformation_vjp(const Tensor& grad, const Tensor& positions,
                                                   const Tensor& inverse_rest,
                                                   const OptionalTensor& fallback,
                                                   at::TensorList constraints, double lower,
                                                   double upper) {
  const DeformationTensors in(positions, inverse_rest, fallback, constraints, lower, upper);
  const auto n = in.constraints.count, points = in.constraints.points;
  const Tensor g = real_argument(grad, positions, {in.batch, n, 3, 3}, "grad", "of the loss");
  const Tensor gx = in.empty({in.batch, points, 3}), gr = in.empty({n, 3, 3});
  const Tensor gradients = in.empty({in.batch, n, 3, 3});
  const bool has_fallback = in.fallback.defined();
  const Tensor gf = in.empty({has_fallback ? in.batch : 0, n, 3, 3});
  for_precision(positions, [&](auto real) {
    using T = decltype(real);
    const DeformationGradients<T> each{
        in.constraints,           read<T>(in.positions),
        read<T>(in.inverse_rest), has_fallback,
        {T(lower), T(upper)},     read<T>(g),
        write<T>(gradients),      has_fallback ? write<T>(gf) : nullptr};
    const DeformationPoints<T> sums{in.constraints, read<T>(in.inverse_rest), read<T>(gradients),
                                    write<T>(gx)};
    const DeformationRest<T> rest{in.constraints, read<T>(in.positions), read<T>(gradients),
                                  in.batch, write<T>(gr)};
    Backend::run(each, in.batch * n, positions);
    Backend::run(sums, in.batch * points, positions);
    Backend::run(rest, n, positions);
  });
  return {gx, gr, gf};
}

struct FrameTensors {
  Lists lists;
  Tensor gradients, weights;
  std::int64_t batch;

  FrameTensors(const Tensor& g, const Tensor& w, at::TensorList arrays) {
    check_batched(g, 4, "gradients", "[batch, patches, 3, 3]");
    lists = lists_view(arrays, {g.device(), "gradients"});
    batch = g.size(0);
    gradients = real_argument(g, g, {batch, lists.patches, 3, 3}, "gradients", "of each patch");
    weights = real_argument(w, g, {lists.patches}, "weights", "area of each patch at rest, m^2");
  }

  Tensor empty(at::IntArrayRef sizes) const { return at::empty(sizes, gradients.options()); }
};

template <class Backend>
Tensor frames(const Tensor& gradients, const Tensor& weights, at::TensorList lists) {
  const FrameTensors in(gradients, weights, lists);
  const Tensor out = in.empty({in.batch, in.lists.vertices, 3, 3});
  for_precision(gradients, [&](auto real) {
    using T = decltype(real);
    const Frames<T> task{in.lists, read<T>(in.gradients), read<T>(in.weights), write<T>(out)};
    Backend::run(task, in.batch * in.lists.vertices, gradients);
  });
  return out;
}

template <class Backend>
std::tuple<Tensor, Tensor> frames_vjp(const Tensor& grad, const Tensor& frames,
                                      const Tensor& gradients, const Tensor& weights,
                                      at::TensorList lists) {
  const FrameTensors in(gradients, weights, lists);
  const auto v = in.lists.vertices, p = in.lists.patches;
  const Tensor g = real_argument(grad, gradients, {in.batch, v, 3, 3}, "grad", "of the loss");
  const Tensor a = real_argument(frames, gradients, {in.batch, v, 3, 3}, "frames", "the result");
  const Tensor gg = in.empty({in.batch, p, 3, 3}), gw = in.empty({p});
  for_precision(gradients, [&](auto real) {
    using T = decltype(real);
    const FramesGradients<T> each{in.lists, read<T>(in.weights), read<T>(g), write<T>(gg)};
    const FramesWeights<T> areas{
        in.lists, read<T>(in.gradients), read<T>(in.weights), read<T>(a), read<T>(g),
        in.batch, write<T>(gw)};
    Backend::run(each, in.batch * p, gradients);
    Backend::run(areas, p, gradients);
  });
  return {gg, gw};
}

}  // namespace pd::freeform
