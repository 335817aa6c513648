#include "plan/gpu/ownership.h"

#include "plan/mesh/bisect.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <span>
#include <utility>

namespace pd {

namespace {

// Cuts vertices in two again and again.
class Owners {
 public:
  Owners(std::int64_t vertices, const std::int64_t* tets, std::int64_t count)
      : weight_(vertices, 0), start_(vertices + 1, 0), at_(4 * count) {
    for (std::int64_t i = 0; i < 4 * count; ++i) ++start_[tets[i] + 1];
    for (std::int64_t v = 0; v < vertices; ++v) weight_[v] = start_[v + 1];
    std::partial_sum(start_.begin(), start_.end(), start_.begin());
    std::vector<std::int64_t> next(start_.begin(), start_.end() - 1);
    for (std::int64_t i = 0; i < 4 * count; ++i) at_[next[tets[i]]++] = std::int32_t(i / 4);
    seen_.assign(count, -1);
  }

  void divide(std::span<Numbered> items, int first, int patches, std::vector<std::int32_t>& owner) {
    if (patches <= 1) {
      for (const Numbered& vertex : items) owner[vertex.number] = first;
      return;
    }
    const int left = patches / 2;
    std::vector<Numbered> best;
    double least = HUGE_VAL;
    std::int64_t middle = 0;
    std::array<int, 3> axis = axes_by_length(items);
    for (int turn = 0; turn < 3; ++turn) {
      std::array<int, 3> order = axis;
      std::rotate(order.begin(), order.begin() + turn, order.begin() + turn + 1);
      std::vector<Numbered> cut(items.begin(), items.end());
      std::sort(cut.begin(), cut.end(), along(order));
      const std::int64_t at = split(cut, left, patches);
      const double cost =
          std::max(double(std::ssize(tets_of(std::span(cut).first(at)))) / left,
                   double(std::ssize(tets_of(std::span(cut).subspan(at)))) / (patches - left));
      if (cost >= least) continue;
      least = cost;
      middle = at;
      best = std::move(cut);
    }
    std::copy(best.begin(), best.end(), items.begin());
    divide(items.first(middle), first, left, owner);
    divide(items.subspan(middle), first + left, patches - left, owner);
  }

  // Tetrahedra that touch some vertices, ascending.
  std::vector<std::int32_t> tets_of(std::span<const Numbered> items) {
    std::vector<std::int32_t> tets;
    ++round_;
    for (const Numbered& vertex : items) {
      for (std::int64_t i = start_[vertex.number]; i < start_[vertex.number + 1]; ++i) {
        if (seen_[at_[i]] == round_) continue;
        seen_[at_[i]] = round_;
        tets.push_back(at_[i]);
      }
    }
    std::sort(tets.begin(), tets.end());
    return tets;
  }

 private:
  // The cut with tetrahedra left and right in the ratio of their patches, and at least one vertex for every patch.
  std::int64_t split(std::span<const Numbered> cut, int left, int patches) const {
    std::int64_t all = 0, sum = 0;
    for (const Numbered& vertex : cut) all += weight_[vertex.number];
    std::int64_t at = 0;
    while (at < std::ssize(cut) && sum * patches < all * left) sum += weight_[cut[at++].number];
    return std::clamp<std::int64_t>(at, left, std::ssize(cut) - (patches - left));
  }

  std::vector<std::int64_t> weight_, start_;  // tetrahedra of each vertex; where at_ has them
  std::vector<std::int32_t> at_;
  std::vector<std::int64_t> seen_;  // last round that met a tetrahedron
  std::int64_t round_ = 0;
};

}  // namespace

Ownership own_vertices(const double* positions, std::int64_t vertices, const std::int64_t* tets,
                       std::int64_t count, std::int64_t patches) {
  Owners cutter(vertices, tets, count);
  std::vector<Numbered> items(vertices);
  for (std::int64_t v = 0; v < vertices; ++v) {
    const double* x = positions + 3 * v;
    items[v] = {{x[0], x[1], x[2]}, std::int32_t(v)};
  }
  Ownership owned{{{}, {0}}, std::vector<std::int32_t>(vertices)};
  cutter.divide(items, 0, int(patches), owned.owner);
  std::vector<std::vector<Numbered>> own(patches);
  for (const Numbered& vertex : items) own[owned.owner[vertex.number]].push_back(vertex);
  for (const std::vector<Numbered>& mine : own) {
    const std::vector<std::int32_t> touched = cutter.tets_of(mine);
    owned.mesh.elements.insert(owned.mesh.elements.end(), touched.begin(), touched.end());
    owned.mesh.start.push_back(std::ssize(owned.mesh.elements));
  }
  return owned;
}

Numbering number_owned(const std::vector<std::int32_t>& owner, int patches) {
  const std::size_t vertices = owner.size();
  Numbering n;
  n.is_shared.assign(vertices, 0);
  n.internal.resize(vertices);
  n.vertex_order.resize(vertices);
  n.patch_vertex.assign(patches + 1, 0);
  for (const std::int32_t p : owner) ++n.patch_vertex[p + 1];
  std::partial_sum(n.patch_vertex.begin(), n.patch_vertex.end(), n.patch_vertex.begin());
  std::vector<std::int32_t> next(n.patch_vertex.begin(), n.patch_vertex.end() - 1);
  for (std::size_t v = 0; v < vertices; ++v) {
    n.internal[v] = next[owner[v]]++;
    n.vertex_order[n.internal[v]] = std::int32_t(v);
  }
  return n;
}

}  // namespace pd
