// Heights and the surface, on either device: checks, views, the tasks one after another.
#pragma once
#include "freeform/binding/checks.h"

#include <tuple>

namespace pd::freeform {

template <class T>
constexpr T phong_lift = T(0.75);  // weight of Phong tessellation that its authors recommend

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
  const Tensor probes = rest.empty({n, probe_size});
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

}  // namespace pd::freeform
