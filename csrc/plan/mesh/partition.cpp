#include "plan/mesh/partition.h"

#include "plan/mesh/bisect.h"

#include <algorithm>
#include <numeric>

namespace pd {

namespace {

// The least coordinates of every element's corners. With this order a cut shares only the vertices on one of its
// sides; an order by centres shares some on both.
std::vector<Point> low_corners(const MeshElements& elements) {
  std::vector<Point> low(elements.count());
  for (std::int64_t e = 0; e < std::ssize(low); ++e) {
    const std::span<const std::int64_t> corners = elements.corners(e);
    for (int c = 0; c < 3; ++c) {
      low[e][c] = elements.positions[3 * corners[0] + c];
      for (const std::int64_t v : corners)
        low[e][c] = std::min(low[e][c], elements.positions[3 * v + c]);
    }
  }
  return low;
}

// Splits [begin, end) of `items` at `middle` across the longest side of the box of their low corners.
void bisect(std::vector<std::int32_t>& items, const std::vector<Point>& corners, std::int64_t begin,
            std::int64_t middle, std::int64_t end) {
  const auto axis = axes_by_length(std::span(items).subspan(begin, end - begin), corners);
  std::nth_element(items.begin() + begin, items.begin() + middle, items.begin() + end,
                   along(axis, corners));
}

void divide(Partition& mesh, const std::vector<Point>& corners, std::int64_t begin,
            std::int64_t end, std::int64_t patches, std::int64_t grain) {
  if (patches <= 1) {
    std::sort(mesh.elements.begin() + begin, mesh.elements.begin() + end);
    mesh.start.push_back(end);
    return;
  }
  const std::int64_t grains = (end - begin + grain - 1) / grain, left = patches / 2;
  const std::int64_t middle = std::min(end, begin + grains * left / patches * grain);
  if (middle > begin && middle < end) bisect(mesh.elements, corners, begin, middle, end);
  divide(mesh, corners, begin, middle, left, grain);
  divide(mesh, corners, middle, end, patches - left, grain);
}

// Orders shared vertices so that those of the same patches are adjacent, and one patch reads another's in a run. The
// sort key is the reversed list of patches: the last patch has all forces on them. `shared` keeps its order
// otherwise.
void gather_by_patches(const Partition& mesh, const MeshElements& elements,
                       const std::vector<std::uint8_t>& is_shared,
                       std::vector<std::int64_t>& shared) {
  std::vector<std::int32_t> number(is_shared.size(), -1);
  for (std::size_t i = 0; i < shared.size(); ++i) number[shared[i]] = std::int32_t(i);
  std::vector<std::vector<std::int32_t>> patches(shared.size());
  for (int p = 0; p < mesh.patches(); ++p) {
    for (const std::int32_t e : mesh.patch(p)) {
      for (const std::int64_t v : elements.corners(e)) {
        const std::int32_t i = number[v];
        if (i >= 0 && (patches[i].empty() || patches[i].back() != p)) patches[i].push_back(p);
      }
    }
  }
  std::stable_sort(shared.begin(), shared.end(), [&](std::int64_t a, std::int64_t b) {
    const auto &one = patches[number[a]], &two = patches[number[b]];
    return std::lexicographical_compare(one.rbegin(), one.rend(), two.rbegin(), two.rend());
  });
}

}  // namespace

Partition partition_mesh(const MeshElements& elements, std::int64_t patches, std::int64_t grain) {
  const std::int64_t count = elements.count();
  Partition mesh{std::vector<std::int32_t>(count), {0}};
  std::iota(mesh.elements.begin(), mesh.elements.end(), 0);
  divide(mesh, low_corners(elements), 0, count, patches, grain);
  return mesh;
}

Numbering number_vertices(const Partition& mesh, const MeshElements& elements) {
  const std::int64_t vertices = elements.vertices;
  Numbering n;
  n.is_shared.assign(vertices, 0);
  n.internal.assign(vertices, -1);
  std::vector<std::int32_t> owner(vertices, -1);  // first patch of each vertex
  std::vector<std::int64_t> by_owner;             // in order of first appearance
  by_owner.reserve(vertices);
  for (int p = 0; p < mesh.patches(); ++p) {
    for (const std::int32_t e : mesh.patch(p)) {
      for (const std::int64_t v : elements.corners(e)) {
        if (owner[v] < 0) {
          owner[v] = p;
          by_owner.push_back(v);
        } else if (owner[v] != p) {
          n.is_shared[v] = 1;
        }
      }
    }
  }
  n.patch_vertex.assign(mesh.patches() + 1, 0);
  n.vertex_order.reserve(by_owner.size());
  const auto append = [&](std::int64_t v) {
    n.internal[v] = std::int32_t(n.vertex_order.size());
    n.vertex_order.push_back(std::int32_t(v));
  };
  std::vector<std::int64_t> shared;
  for (const std::int64_t v : by_owner) {
    if (n.is_shared[v]) {
      shared.push_back(v);
    } else {
      append(v);
      ++n.patch_vertex[owner[v] + 1];
    }
  }
  gather_by_patches(mesh, elements, n.is_shared, shared);
  for (const std::int64_t v : shared) append(v);
  std::partial_sum(n.patch_vertex.begin(), n.patch_vertex.end(), n.patch_vertex.begin());
  return n;
}

SharedSlots link_shared(const std::vector<std::int32_t>& slot_vertex, std::int32_t first_shared,
                        std::int64_t vertices) {
  SharedSlots shared;
  shared.start.assign(vertices - first_shared + 1, 0);
  for (const std::int32_t v : slot_vertex) {
    if (v >= first_shared) ++shared.start[v - first_shared + 1];
  }
  std::partial_sum(shared.start.begin(), shared.start.end(), shared.start.begin());
  shared.slot.resize(shared.start.back());
  std::vector<std::int32_t> next(shared.start.begin(), shared.start.end() - 1);
  for (std::size_t slot = 0; slot < slot_vertex.size(); ++slot) {
    const std::int32_t v = slot_vertex[slot];
    if (v >= first_shared) shared.slot[next[v - first_shared]++] = std::int32_t(slot);
  }
  return shared;
}

}  // namespace pd
