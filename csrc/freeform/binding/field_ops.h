// The published field, on either device: checks, views, the tasks one after another.
#pragma once
#include "freeform/binding/checks.h"

#include <cmath>
#include <tuple>

namespace pd::freeform {

struct SolidTensors {
  Lists lists;
  Tensor points, positions, amplitudes, matrices;
  std::int64_t batch, sets;

  SolidTensors(const Tensor& x, const Tensor& v, const Tensor& a, const Tensor& w,
               at::TensorList arrays) {
    check_batched(x, 3, "points", "[batch, samples, 3] (m)");
    check_batched(w, 4, "matrices", "[1 or batch, quadrics, 4, 4]");
    lists = lists_view(arrays, {x.device(), "points"});
    batch = x.size(0);
    sets = w.size(0);
    TORCH_CHECK_VALUE(sets == 1 || sets == batch, "matrices must be one set or one for each of ",
                      batch, " poses, got ", describe(w));
    points = real_argument(x, x, {batch, lists.samples, 3}, "points", "m");
    positions = real_argument(v, x, {batch, lists.vertices, 3}, "positions", "m");
    amplitudes = real_argument(a, x, {lists.quadrics}, "amplitudes", "of each quadric");
    matrices =
        real_argument(w, x, {sets, lists.quadrics, 4, 4}, "matrices", "Q(x) = (x, 1) W (x, 1)");
  }

  template <class T>
  PaperField<T> view(double thickness, bool clip) const {
    return {lists,
            read<T>(points),
            read<T>(positions),
            read<T>(amplitudes),
            read<T>(matrices),
            sets > 1 ? 16 * lists.quadrics : 0,
            T(thickness),
            clip};
  }

  Tensor empty(at::IntArrayRef sizes) const { return at::empty(sizes, points.options()); }
};

inline void check_thickness(double thickness) {
  TORCH_CHECK_VALUE(thickness >= 0 && std::isfinite(thickness),
                    "thickness must be finite and >= 0 [m], got ", thickness);
}

template <class Backend>
Tensor solid_field(const Tensor& points, const Tensor& positions, const Tensor& amplitudes,
                   const Tensor& matrices, at::TensorList lists, double thickness, bool clip) {
  check_thickness(thickness);
  const SolidTensors in(points, positions, amplitudes, matrices, lists);
  const Tensor out = in.empty({in.batch, in.lists.samples});
  for_precision(points, [&](auto real) {
    using T = decltype(real);
    const PaperFieldValues<T> task{in.view<T>(thickness, clip), write<T>(out)};
    Backend::run(task, out.numel(), points);
  });
  return out;
}

template <class Backend>
std::tuple<Tensor, Tensor, Tensor, Tensor> solid_field_vjp(
    const Tensor& grad, const Tensor& points, const Tensor& positions, const Tensor& amplitudes,
    const Tensor& matrices, at::TensorList lists, double thickness, bool clip) {
  check_thickness(thickness);
  const SolidTensors in(points, positions, amplitudes, matrices, lists);
  const auto n = in.lists.samples, v = in.lists.vertices, q = in.lists.quadrics;
  const Tensor g = real_argument(grad, points, {in.batch, n}, "grad", "of the loss");
  const Tensor gx = in.empty({in.batch, n, 3}), gv = in.empty({in.batch, v, 3});
  const Tensor ga = in.empty({q}), gw = in.empty({in.sets, q, 4, 4});
  const Tensor corners = in.empty({in.batch, n, 9});
  const Tensor partial = in.empty({in.sets, in.lists.entries, 17});
  for_precision(points, [&](auto real) {
    using T = decltype(real);
    const PaperField<T> solid = in.view<T>(thickness, clip);
    const PaperFieldSamples<T> samples{solid, read<T>(g), write<T>(gx), write<T>(corners)};
    const PaperFieldVertices<T> sums{in.lists, read<T>(corners), write<T>(gv)};
    const PaperFieldEntries<T> entries{solid, read<T>(g), in.batch, in.sets, write<T>(partial)};
    const PaperFieldQuadrics<T> quadrics{in.lists, read<T>(partial), in.sets, write<T>(ga),
                                         write<T>(gw)};
    Backend::run(samples, in.batch * n, points);
    Backend::run(sums, in.batch * v, points);
    Backend::run(entries, in.sets * in.lists.entries, points);
    Backend::run(quadrics, q, points);
  });
  return {gx, gv, ga, gw};
}

}  // namespace pd::freeform
