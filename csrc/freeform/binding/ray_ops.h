// Rays, on either device: checks, views, the tasks one after another.
#pragma once
#include "freeform/binding/field_ops.h"
#include "freeform/binding/surface_ops.h"

#include <algorithm>
#include <limits>
#include <tuple>
#include <vector>

namespace pd::freeform {

// Origins and directions, of every pose or the same for all.
struct RayTensors {
  Tensor origins, directions;
  std::int64_t count;
  double near, far;

  RayTensors(const Tensor& o, const Tensor& d, std::int64_t batch, double from, double to)
      : near(from), far(to) {
    check_batched(o, 3, "origins", "[1 or batch, rays, 3] (m)");
    check_batched(d, 3, "directions", "[1 or batch, rays, 3]");
    TORCH_CHECK_VALUE(from >= 0 && from <= to,
                      "near and far must satisfy 0 <= near <= far [m], got ", from, " and ", to);
    count = o.size(1);
    for (const Tensor& t : {o, d}) {
      TORCH_CHECK_VALUE(t.size(0) == 1 || t.size(0) == batch,
                        "origins and directions must be of 1 or of all ", batch, " poses, got ",
                        describe(t));
    }
    origins = real_argument(o, o, {o.size(0), count, 3}, "origins", "m");
    directions = real_argument(d, o, {d.size(0), count, 3}, "directions", "of the rays");
  }

  template <class T>
  Rays<T> view() const {
    return {read<T>(origins),
            read<T>(directions),
            count,
            origins.size(0) > 1 ? 3 * count : 0,
            directions.size(0) > 1 ? 3 * count : 0,
            T(near),
            T(far)};
  }
};

constexpr auto ray_arrays = "PatchRays makes it";

// The checks of a cell are those of a grid of four segments.
inline void check_cells(const Tensor& cells, const Tensor& like, std::int64_t samples,
                        std::int64_t patches, std::int64_t level) {
  TORCH_CHECK_VALUE(level >= 1, "level must be at least 1, got ", level);
  TORCH_CHECK_VALUE(cells.dim() == 2 && cells.size(0) >= 1, "cells must be int32 [count > 0, ",
                    cell_size, "], got ", describe(cells));
  check_array(cells, at::kInt, cells.size(0), cell_size, {like.device(), "positions"}, "cells",
              "corners, checks, patch and place of each", ray_arrays);
  // on a GPU, where no op may wait, the kernels leave out a cell that is none
  if (!cells.is_cpu()) return;
  const std::int64_t places = level * level;
  const int32* first = cells.const_data_ptr<int32>();
  for (std::int64_t n = 0; n < cells.size(0); ++n) {
    const int32* cell = first + cell_size * n;
    TORCH_CHECK_INDEX(is_cell(cell, samples, patches, places),
                      "cells must hold corners and checks in 0..", samples - 1, ", patches in 0..",
                      patches - 1, " and places in 0..", places - 1, ", got ",
                      at::IntArrayRef(std::vector<std::int64_t>(cell, cell + cell_size)), " at ", n,
                      "; ", ray_arrays);
  }
}

// A permutation of the patches.
inline void check_order(const Tensor& order, std::int64_t patches, const Place& place) {
  check_array(order, at::kInt, patches, 1, place, "order",
              "patches, in the order of the leaves of their tree", ray_arrays);
  // on a GPU, where no op may wait, the kernels leave out a patch that is none
  if (!order.is_cpu()) return;
  const int32* patch = order.const_data_ptr<int32>();
  std::vector<bool> seen(patches);
  for (std::int64_t n = 0; n < patches; ++n) {
    TORCH_CHECK_INDEX(is_below(patch[n], patches) && !seen[patch[n]],
                      "order must hold each patch in 0..", patches - 1, " once, got ", patch[n],
                      " at ", n, "; ", ray_arrays);
    seen[patch[n]] = true;
  }
}

// Levels of the tree with so many things a leaf or more, and less than twice as many.
inline int levels_of(std::int64_t count, std::int64_t per_leaf) {
  int levels = 0;
  while ((2 * per_leaf << levels) <= count) ++levels;
  return levels;
}

inline Tensor empty_boxes(std::int64_t batch, int levels, const Tensor& like) {
  const auto fours = std::max(std::int64_t(1), std::int64_t(1) << levels >> 1);
  return at::empty({batch, fours, 6, 4}, like.options());
}

template <class Backend, class T>
void join_boxes(const Tree<T>& tree, std::int64_t batch, const Tensor& like) {
  for (int k = tree.levels - 1; k >= 0; --k)
    Backend::run(JoinedBoxes<T>{tree, k}, batch << k, like);
}

using Five = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

template <class Backend>
Five surface_rays(const Tensor& origins, const Tensor& directions, const Tensor& barycentrics,
                  const Tensor& cells, const Tensor& weights, const Tensor& places,
                  const Tensor& positions, const Tensor& frames, const Tensor& vertices,
                  const Tensor& directors, const Tensor& amplitudes, const Tensor& centres,
                  const Tensor& factors, at::TensorList arrays, std::int64_t level, bool on_surface,
                  bool phong, bool shape, double near, double far) {
  check_batched(positions, 3, "positions", "[batch, vertices, 3] (m)");
  const Lists lists = lists_view(arrays, {positions.device(), "positions"});
  const auto batch = positions.size(0), q = lists.quadrics, v = lists.vertices;
  const RayTensors rays(origins, directions, batch, near, far);
  check_cells(cells, positions, lists.samples, lists.patches, level);
  const auto real = [&](const Tensor& t, at::IntArrayRef sizes, const char* name,
                        const char* meaning) {
    return real_argument(t, positions, sizes, name, meaning);
  };
  const Tensor at_rest = real(vertices, {v, 3}, "vertices", "m"),
               n = real(directors, {v, 3}, "directors", "of unit length"),
               a = real(amplitudes, {q}, "amplitudes", "m"),
               c = real(centres, {q, 3}, "centres", "m"),
               m = real(factors, {q, 6}, "factors", "1/m"),
               posed = real(positions, {batch, v, 3}, "positions", "m"),
               turned = real(frames, {batch, v, 3, 3}, "frames", "of the vertices"),
               grid = real(barycentrics, {lists.samples, 3}, "barycentrics", "of the grid"),
               inner = real(weights, {check_points, 3}, "weights", "of the checks of a cell"),
               place =
                   real(places, {level * level, 9}, "places", "corners of the cells of a patch");
  real(rays.origins, rays.origins.sizes(), "origins", "m");
  const int levels = levels_of(cells.size(0), 2);  // at most four cells a leaf, side by side
  const auto empty = [&](at::IntArrayRef sizes) { return at::empty(sizes, positions.options()); };
  const Tensor sheets = empty({batch, lists.patches, posed_patch_size});
  const Tensor bumps = empty({lists.entries / 4 + lists.patches + 1, bump_simd4_size});
  const Tensor heights = empty({lists.samples}), points = empty({batch, lists.samples, 3});
  const Tensor fours = empty({batch, std::int64_t(1) << levels, cell_simd4_size});
  const Tensor boxes = empty_boxes(batch, levels, positions);
  const Tensor depth = empty({batch, rays.count}), b = empty({batch, rays.count, 3});
  const Tensor patch = at::empty({batch, rays.count}, positions.options().dtype(at::kInt));
  const auto shaped = shape ? rays.count : 0;
  const Tensor hits = empty({batch, shaped, 3}), normals = empty({batch, shaped, 3});
  if (depth.numel() == 0) return {depth, patch, b, hits, normals};
  for_precision(positions, [&](auto number) {
    using T = decltype(number);
    const Base<T> base{read<T>(at_rest), read<T>(n), phong ? phong_lift<T> : T(0)};
    const Ellipsoids<T> ellipsoids{read<T>(a), read<T>(c), read<T>(m)};
    Backend::run(PosedPatches<T>{lists, base, read<T>(posed), read<T>(turned), write<T>(sheets)},
                 batch * lists.patches, positions);
    Backend::run(GatheredBumps<T>{lists, ellipsoids, write<T>(bumps)}, lists.patches, positions);
    const PosedSurface<T> surface{lists, read<T>(sheets), read<T>(bumps), base.lift, on_surface};
    Backend::run(GridHeights<T>{surface, read<T>(grid), write<T>(heights)}, lists.samples,
                 positions);
    Backend::run(GridPoints<T>{surface, read<T>(grid), read<T>(heights), write<T>(points)},
                 batch * lists.samples, positions);
    const Tree<T> tree{write<T>(boxes), cells.size(0), levels};
    const Cells<T> in{tree,           read<int32>(cells), read<T>(inner),
                      read<T>(place), read<T>(points),    write<T>(fours),
                      lists.samples,  lists.patches,      level * level,
                      T(1) / T(level)};
    Backend::run(CellBoxes<T>{in}, batch << levels, positions);
    join_boxes<Backend>(tree, batch, positions);
    const SurfaceRays<T> task{surface,
                              in,
                              rays.view<T>(),
                              write<T>(depth),
                              write<int32>(patch),
                              write<T>(b),
                              shape ? write<T>(hits) : nullptr,
                              shape ? write<T>(normals) : nullptr};
    Backend::run(task, batch * rays.count, positions);
  });
  return {depth, patch, b, hits, normals};
}

template <class Backend>
std::tuple<Tensor, Tensor> field_rays(const Tensor& origins, const Tensor& directions,
                                      const Tensor& positions, const Tensor& amplitudes,
                                      const Tensor& matrices, const Tensor& order,
                                      at::TensorList arrays, double thickness, bool clip,
                                      double near, double far, bool exhaustive) {
  check_thickness(thickness);
  check_batched(positions, 3, "positions", "[batch, vertices, 3] (m)");
  TORCH_CHECK_VALUE(far <= std::numeric_limits<float>::max(), "far must be finite [m], got ", far);
  const RayTensors rays(origins, directions, positions.size(0), near, far);
  // no samples: a point of each pose stands in for them
  const Tensor points = at::empty({positions.size(0), 0, 3}, positions.options());
  const SolidTensors in(points, positions, amplitudes, matrices, arrays);
  real_argument(rays.origins, positions, rays.origins.sizes(), "origins", "m");
  check_order(order, in.lists.patches, {positions.device(), "positions"});
  const int levels = levels_of(in.lists.patches, 1);
  const Tensor boxes = empty_boxes(in.batch, levels, positions);
  const Tensor depth = in.empty({in.batch, rays.count});
  const Tensor patch = at::empty({in.batch, rays.count}, positions.options().dtype(at::kInt));
  for_precision(positions, [&](auto real) {
    using T = decltype(real);
    const Tree<T> tree{write<T>(boxes), in.lists.patches, levels};
    const PaperField<T> solid = in.view<T>(thickness, clip);
    if (!exhaustive) {
      Backend::run(FieldBoxes<T>{solid, tree, read<int32>(order)}, in.batch << levels, positions);
      join_boxes<Backend>(tree, in.batch, positions);
    }
    const FieldRays<T> task{solid,
                            tree,
                            read<int32>(order),
                            exhaustive,
                            rays.view<T>(),
                            write<T>(depth),
                            write<int32>(patch)};
    Backend::run(task, depth.numel(), positions);
  });
  return {depth, patch};
}

}  // namespace pd::freeform
