// What every op of free-form patches does on either device: checks, views, the tasks one after another.
//
// A Backend has `run(task, count, like)`, which computes the items of a task on the device of the tensor `like`.
#pragma once
#include "freeform_checks.h"

#include <ATen/ATen.h>
#include <torch/library.h>

#include <optional>
#include <tuple>

namespace pd::freeform {

using OptionalTensor = std::optional<Tensor>;

template <class Work>
void for_precision(const Tensor& like, Work work) {
  if (like.scalar_type() == at::kFloat) {
    work(float());
  } else {
    work(double());
  }
}

template <class T>
const T* read(const Tensor& t) {
  return t.const_data_ptr<T>();
}

template <class T>
T* write(const Tensor& t) {
  return t.mutable_data_ptr<T>();
}

template <class T>
constexpr T phong_lift = T(0.75);

// The surface at rest and where it is asked for, checked.
struct RestTensors {
  Lists lists;
  Tensor vertices, directors, barycentrics;

  RestTensors(const Tensor& v, const Tensor& d, const Tensor& b, at::TensorList arrays) {
    check_batched(v, 2, "vertices", "[vertices, 3] (m)");
    lists = lists_view(arrays, {v.device(), "vertices"});
    vertices = real_argument(v, v, {lists.vertices, 3}, "vertices", "m");
    directors = real_argument(d, v, {lists.vertices, 3}, "directors", "unit vectors");
    barycentrics =
        real_argument(b, v, {lists.samples, 3}, "barycentrics", "coordinates of each sample");
  }

  template <class T>
  Base<T> base(bool phong) const {
    return {read<T>(vertices), read<T>(directors), phong ? phong_lift<T> : T(0)};
  }

  Tensor empty(at::IntArrayRef sizes) const { return at::empty(sizes, vertices.options()); }
};

struct QuadricTensors {
  Tensor amplitudes, centres, factors;

  QuadricTensors(const Tensor& a, const Tensor& c, const Tensor& m, const RestTensors& rest) {
    const auto n = rest.lists.quadrics;
    amplitudes = real_argument(a, rest.vertices, {n}, "amplitudes", "height of each quadric, m");
    centres = real_argument(c, rest.vertices, {n, 3}, "centres", "m");
    factors = real_argument(m, rest.vertices, {n, 6}, "factors",
                            "M00 M11 M22 M10 M20 M21 of each quadric, 1/m");
  }

  template <class T>
  Ellipsoids<T> view() const {
    return {read<T>(amplitudes), read<T>(centres), read<T>(factors)};
  }
};

template <class Backend>
std::tuple<Tensor, Tensor> height(const Tensor& vertices, const Tensor& directors,
                                  const Tensor& amplitudes, const Tensor& centres,
                                  const Tensor& factors, const Tensor& barycentrics,
                                  at::TensorList lists, bool on_surface, bool phong) {
  const RestTensors rest(vertices, directors, barycentrics, lists);
  const QuadricTensors quadrics(amplitudes, centres, factors, rest);
  const Tensor heights = rest.empty({rest.lists.samples});
  const Tensor slopes = rest.empty({rest.lists.samples, 2});
  for_precision(vertices, [&](auto real) {
    using T = decltype(real);
    const Height<T> task{
        rest.lists, rest.base<T>(phong), quadrics.view<T>(), read<T>(rest.barycentrics),
        on_surface, write<T>(heights),   write<T>(slopes)};
    Backend::run(task, rest.lists.samples, vertices);
  });
  return {heights, slopes};
}

using Six = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

template <class Backend>
Six height_vjp(const Tensor& grad_heights, const Tensor& grad_slopes, const Tensor& heights,
               const Tensor& vertices, const Tensor& directors, const Tensor& amplitudes,
               const Tensor& centres, const Tensor& factors, const Tensor& barycentrics,
               at::TensorList lists, bool on_surface, bool phong) {
  const RestTensors rest(vertices, directors, barycentrics, lists);
  const QuadricTensors quadrics(amplitudes, centres, factors, rest);
  const auto n = rest.lists.samples, q = rest.lists.quadrics;
  const Tensor gh = real_argument(grad_heights, vertices, {n}, "grad_heights", "of the loss");
  const Tensor gs = real_argument(grad_slopes, vertices, {n, 2}, "grad_slopes", "of the loss");
  const Tensor h = real_argument(heights, vertices, {n}, "heights", "m");
  const Tensor gv = rest.empty({rest.lists.vertices, 3}), gd = rest.empty({rest.lists.vertices, 3});
  const Tensor ga = rest.empty({q}), gc = rest.empty({q, 3}), gm = rest.empty({q, 6});
  const Tensor gb = rest.empty({n, 3}), corners = rest.empty({n, corner_numbers});
  const Tensor probes = rest.empty({n, probe_numbers});
  const Tensor partial = rest.empty({rest.lists.entries, 10});
  for_precision(vertices, [&](auto real) {
    using T = decltype(real);
    const auto bumps = quadrics.view<T>();
    const HeightSamples<T> samples{
        rest.lists,   rest.base<T>(phong), bumps,           read<T>(rest.barycentrics),
        read<T>(h),   read<T>(gh),         read<T>(gs),     on_surface,
        write<T>(gb), write<T>(corners),   write<T>(probes)};
    const HeightEntries<T> entries{rest.lists, bumps, read<T>(probes), write<T>(partial)};
    const HeightQuadrics<T> sums{rest.lists, read<T>(partial), write<T>(ga), write<T>(gc),
                                 write<T>(gm)};
    const CornerSum<T> vertex{rest.lists, read<T>(corners), write<T>(gv), write<T>(gd)};
    Backend::run(samples, n, vertices);
    Backend::run(entries, rest.lists.entries, vertices);
    Backend::run(sums, q, vertices);
    Backend::run(vertex, rest.lists.vertices, vertices);
  });
  return {gv, gd, ga, gc, gm, gb};
}

// A pose, and what is known of the samples at rest.
struct PoseTensors {
  RestTensors rest;
  Tensor positions, frames, heights, slopes;
  std::int64_t batch;

  PoseTensors(const Tensor& x, const Tensor& a, const Tensor& v, const Tensor& d, const Tensor& h,
              const Tensor& s, const Tensor& b, at::TensorList lists)
      : rest(v, d, b, lists) {
    check_batched(x, 3, "positions", "[batch, vertices, 3] (m)");
    batch = x.size(0);
    const auto n = rest.lists.samples, vertices = rest.lists.vertices;
    positions = real_argument(x, v, {batch, vertices, 3}, "positions", "m");
    frames = real_argument(a, v, {batch, vertices, 3, 3}, "frames", "a matrix for each vertex");
    heights = real_argument(h, v, {n}, "heights", "of each sample, m");
    slopes = real_argument(s, v, {n, 2}, "slopes", "derivatives of the heights, m");
  }
};

template <class Backend>
std::tuple<Tensor, Tensor> surface(const Tensor& positions, const Tensor& frames,
                                   const Tensor& vertices, const Tensor& directors,
                                   const Tensor& heights, const Tensor& slopes,
                                   const Tensor& barycentrics, at::TensorList lists, bool phong) {
  const PoseTensors in(positions, frames, vertices, directors, heights, slopes, barycentrics,
                       lists);
  const auto n = in.rest.lists.samples;
  const Tensor points = in.rest.empty({in.batch, n, 3}),
               tangents = in.rest.empty({in.batch, n, 2, 3});
  for_precision(vertices, [&](auto real) {
    using T = decltype(real);
    const Surface<T> task{in.rest.lists,
                          in.rest.base<T>(phong),
                          read<T>(in.heights),
                          read<T>(in.slopes),
                          read<T>(in.rest.barycentrics),
                          read<T>(in.positions),
                          read<T>(in.frames),
                          write<T>(points),
                          write<T>(tangents)};
    Backend::run(task, in.batch * n, vertices);
  });
  return {points, tangents};
}

using Seven = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

template <class Backend>
Seven surface_vjp(const Tensor& grad_points, const Tensor& grad_tangents, const Tensor& positions,
                  const Tensor& frames, const Tensor& vertices, const Tensor& directors,
                  const Tensor& heights, const Tensor& slopes, const Tensor& barycentrics,
                  at::TensorList lists, bool phong) {
  const PoseTensors in(positions, frames, vertices, directors, heights, slopes, barycentrics,
                       lists);
  const auto n = in.rest.lists.samples, v = in.rest.lists.vertices;
  const Tensor gp =
      real_argument(grad_points, vertices, {in.batch, n, 3}, "grad_points", "of the loss");
  const Tensor gt =
      real_argument(grad_tangents, vertices, {in.batch, n, 2, 3}, "grad_tangents", "of the loss");
  const auto empty = [&](at::IntArrayRef sizes) { return in.rest.empty(sizes); };
  const Tensor gx = empty({in.batch, v, 3}), ga = empty({in.batch, v, 3, 3});
  const Tensor gv = empty({v, 3}), gd = empty({v, 3});
  const Tensor gh = empty({n}), gs = empty({n, 2}), gb = empty({n, 3});
  const Tensor corners = empty({n, corner_numbers});
  for_precision(vertices, [&](auto real) {
    using T = decltype(real);
    const auto base = in.rest.base<T>(phong);
    const T *h = read<T>(in.heights), *s = read<T>(in.slopes), *b = read<T>(in.rest.barycentrics);
    const SurfaceSamples<T> samples{in.rest.lists,
                                    base,
                                    h,
                                    s,
                                    b,
                                    read<T>(in.positions),
                                    read<T>(in.frames),
                                    read<T>(gp),
                                    read<T>(gt),
                                    in.batch,
                                    write<T>(gh),
                                    write<T>(gs),
                                    write<T>(gb),
                                    write<T>(corners)};
    const CornerSum<T> sums{in.rest.lists, read<T>(corners), write<T>(gv), write<T>(gd)};
    const SurfacePose<T> pose{in.rest.lists, base,         h,           s, b, read<T>(gp),
                              read<T>(gt),   write<T>(gx), write<T>(ga)};
    Backend::run(samples, n, vertices);
    Backend::run(sums, v, vertices);
    Backend::run(pose, in.batch * v, vertices);
  });
  return {gx, ga, gv, gd, gh, gs, gb};
}

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
  Solid<T> view(double thickness, bool clip) const {
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
    const SolidField<T> task{in.view<T>(thickness, clip), write<T>(out)};
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
    const Solid<T> solid = in.view<T>(thickness, clip);
    const SolidSamples<T> samples{solid, read<T>(g), write<T>(gx), write<T>(corners)};
    const SolidVertices<T> sums{in.lists, read<T>(corners), write<T>(gv)};
    const SolidEntries<T> entries{solid, read<T>(g), in.batch, in.sets, write<T>(partial)};
    const SolidQuadrics<T> quadrics{in.lists, read<T>(partial), in.sets, write<T>(ga),
                                    write<T>(gw)};
    Backend::run(samples, in.batch * n, points);
    Backend::run(sums, in.batch * v, points);
    Backend::run(entries, in.sets * in.lists.entries, points);
    Backend::run(quadrics, q, points);
  });
  return {gx, gv, ga, gw};
}

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

template <class Backend>
void register_ops(torch::Library& m) {
  m.impl("patch_height", &height<Backend>);
  m.impl("patch_height_vjp", &height_vjp<Backend>);
  m.impl("patch_surface", &surface<Backend>);
  m.impl("patch_surface_vjp", &surface_vjp<Backend>);
  m.impl("patch_field", &solid_field<Backend>);
  m.impl("patch_field_vjp", &solid_field_vjp<Backend>);
  m.impl("patch_deformation", &deformation<Backend>);
  m.impl("patch_deformation_vjp", &deformation_vjp<Backend>);
  m.impl("patch_frames", &frames<Backend>);
  m.impl("patch_frames_vjp", &frames_vjp<Backend>);
}

}  // namespace pd::freeform
