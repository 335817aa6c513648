#include "plan/mesh/partition.h"

#include "plan/mesh/bisect.h"
#include "threads/team.h"

#include <algorithm>
#include <array>
#include <numeric>
#include <utility>

namespace pd {

namespace {

// The least coordinates of every element's corners. With this order a cut shares only the vertices on one of its
// sides; an order by centres shares some on both.
std::vector<Numbered> low_corners(const MeshElements& elements) {
  std::vector<Numbered> low(elements.count());
  run_team(most_threads(), [&](const Team& team) {
    for (std::int64_t e = team.begin(std::ssize(low)); e < team.end(std::ssize(low)); ++e) {
      const std::span<const std::int64_t> corners = elements.corners(e);
      low[e].number = std::int32_t(e);
      for (int c = 0; c < 3; ++c) {
        double least = elements.positions[3 * corners[0] + c];
        for (const std::int64_t v : corners) least = std::min(least, elements.positions[3 * v + c]);
        low[e].point[c] = least;
      }
    }
  });
  return low;
}

// Some elements, [begin, end), for some patches from `first` on.
struct Share {
  std::int64_t begin, end, first, patches;
};

// Cuts elements in two again and again.
class Bisection {
 public:
  Bisection(const MeshElements& elements, std::int64_t patches, std::int64_t grain)
      : items_(low_corners(elements)),
        grain_(grain),
        mesh_{std::vector<std::int32_t>(items_.size()), std::vector<std::int64_t>(patches + 1, 0)} {
    const std::vector<Share> shares = divide_together({0, std::ssize(items_), 0, patches});
    run_team(most_threads(), [&](const Team& team) {
      for (std::int64_t i = team.rank; i < std::ssize(shares); i += team.size) divide(shares[i]);
    });
  }

  Partition take() { return std::move(mesh_); }

 private:
  // Both parts of a share, cut across the longest side of the box of their low corners.
  std::array<Share, 2> bisect(const Share& share) {
    const auto [begin, end, first, patches] = share;
    const std::int64_t grains = (end - begin + grain_ - 1) / grain_, left = patches / 2;
    const std::int64_t middle = std::min(end, begin + grains * left / patches * grain_);
    if (middle > begin && middle < end) {
      const auto axis = axes_by_length(std::span(items_).subspan(begin, end - begin));
      std::nth_element(items_.begin() + begin, items_.begin() + middle, items_.begin() + end,
                       along(axis));
    }
    return {{{begin, middle, first, left}, {middle, end, first + left, patches - left}}};
  }

  void divide(const Share& share) {
    if (share.patches > 1) {
      for (const Share& half : bisect(share)) divide(half);
      return;
    }
    std::int32_t* elements = mesh_.elements.data();
    for (std::int64_t i = share.begin; i < share.end; ++i) elements[i] = items_[i].number;
    std::sort(elements + share.begin, elements + share.end);
    mesh_.start[share.first + 1] = share.end;
  }

  // The shares of the first cuts, which leave work for every thread.
  std::vector<Share> divide_together(const Share& all) {
    constexpr int cuts = 6;
    std::vector<Share> shares = {all};
    for (int cut = 0; cut < cuts; ++cut) {
      std::vector<std::array<Share, 2>> halves(shares.size());
      run_team(most_threads(), [&](const Team& team) {
        for (std::int64_t i = team.rank; i < std::ssize(shares); i += team.size) {
          if (shares[i].patches > 1) halves[i] = bisect(shares[i]);
        }
      });
      std::vector<Share> next;
      for (std::size_t i = 0; i < shares.size(); ++i) {
        if (shares[i].patches > 1)
          next.insert(next.end(), halves[i].begin(), halves[i].end());
        else
          next.push_back(shares[i]);
      }
      shares = std::move(next);
    }
    return shares;
  }

  std::vector<Numbered> items_;
  std::int64_t grain_;
  Partition mesh_;
};

// A vertex of a patch.
struct Visit {
  std::int32_t vertex, patch;
};

// The vertices of every patch as they appear in it, patch by patch.
std::vector<std::vector<Visit>> visits_of(const Partition& mesh, const MeshElements& elements) {
  std::vector<std::vector<Visit>> parts(most_threads());
  run_team(most_threads(), [&](const Team& team) {
    std::vector<std::int32_t> last(elements.vertices, -1);
    std::vector<Visit>& visits = parts[team.rank];
    visits.reserve(2 * elements.vertices / team.size);
    for (std::int64_t p = team.begin(mesh.patches()); p < team.end(mesh.patches()); ++p) {
      for (const std::int32_t e : mesh.patch(int(p))) {
        for (const std::int64_t v : elements.corners(e)) {
          if (last[v] == p) continue;
          last[v] = std::int32_t(p);
          visits.push_back({std::int32_t(v), std::int32_t(p)});
        }
      }
    }
  });
  return parts;
}

// Calls work(visit) for all of them in order.
template <class Work>
void for_visits(const std::vector<std::vector<Visit>>& parts, Work work) {
  for (const std::vector<Visit>& part : parts) std::for_each(part.begin(), part.end(), work);
}

// Orders shared vertices so that those of the same patches are adjacent, and one patch reads another's in a run. The
// sort key is the reversed list of patches: the last patch has all forces on them. `shared` keeps its order
// otherwise.
void gather_by_patches(const std::vector<std::vector<Visit>>& visits,
                       const std::vector<std::int32_t>& patches_of,
                       std::vector<std::int32_t>& shared) {
  struct List {
    std::int32_t vertex;
    std::int64_t begin, end;
  };
  std::vector<List> lists;
  lists.reserve(shared.size());
  std::vector<std::int32_t> number(patches_of.size(), -1);
  std::int64_t end = 0;
  for (const std::int32_t v : shared) {
    number[v] = std::int32_t(lists.size());
    end += patches_of[v];
    lists.push_back({v, end, end});
  }
  std::vector<std::int32_t> patches(end);
  for_visits(visits, [&](const Visit& visit) {
    if (const std::int32_t i = number[visit.vertex]; i >= 0)
      patches[--lists[i].begin] = visit.patch;
  });
  std::stable_sort(lists.begin(), lists.end(), [&](const List& a, const List& b) {
    return std::lexicographical_compare(patches.begin() + a.begin, patches.begin() + a.end,
                                        patches.begin() + b.begin, patches.begin() + b.end);
  });
  std::ranges::transform(lists, shared.begin(), &List::vertex);
}

}  // namespace

Partition partition_mesh(const MeshElements& elements, std::int64_t patches, std::int64_t grain) {
  return Bisection(elements, std::max<std::int64_t>(patches, 1), grain).take();
}

Numbering number_vertices(const Partition& mesh, const MeshElements& elements) {
  const std::vector<std::vector<Visit>> visits = visits_of(mesh, elements);
  std::vector<std::int32_t> patches_of(elements.vertices, 0);
  for_visits(visits, [&](const Visit& visit) { ++patches_of[visit.vertex]; });
  Numbering n;
  n.is_shared.assign(elements.vertices, 0);
  n.internal.assign(elements.vertices, -1);
  n.patch_vertex.assign(mesh.patches() + 1, 0);
  n.vertex_order.reserve(elements.vertices);
  const auto append = [&](std::int32_t v) {
    n.internal[v] = std::int32_t(n.vertex_order.size());
    n.vertex_order.push_back(v);
  };
  std::vector<std::int32_t> shared;
  for_visits(visits, [&](const Visit& visit) {
    const auto [v, p] = visit;
    if (patches_of[v] == 1) {
      append(v);
      ++n.patch_vertex[p + 1];
    } else if (!n.is_shared[v]) {
      n.is_shared[v] = 1;
      shared.push_back(v);
    }
  });
  gather_by_patches(visits, patches_of, shared);
  for (const std::int32_t v : shared) append(v);
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
