#include "plan/build.h"

#define PD_NO_FMA
#include "math/mat.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pd {

namespace {

constexpr int lanes = 16;
using Point = std::array<double, 3>;

// Splits [begin, end) of `items` at `middle` across the longest side of the box of their centres.
void bisect(std::vector<std::int32_t>& items, const std::vector<Point>& centres, std::int64_t begin,
            std::int64_t middle, std::int64_t end) {
  Point low = centres[items[begin]], high = low;
  for (std::int64_t i = begin; i < end; ++i) {
    for (int c = 0; c < 3; ++c) {
      low[c] = std::min(low[c], centres[items[i]][c]);
      high[c] = std::max(high[c], centres[items[i]][c]);
    }
  }
  int axis = 0;
  for (int c = 1; c < 3; ++c) {
    if (high[c] - low[c] > high[axis] - low[axis]) axis = c;
  }
  // ties fall to the number, so that every platform makes the same plan
  std::nth_element(
      items.begin() + begin, items.begin() + middle, items.begin() + end, [&](auto a, auto b) {
        return centres[a][axis] != centres[b][axis] ? centres[a][axis] < centres[b][axis] : a < b;
      });
}

// Recursive coordinate bisection into `parts` ranges of nearly equal size, whole blocks but for the last.
void partition(std::vector<std::int32_t>& items, const std::vector<Point>& centres,
               std::int64_t begin, std::int64_t end, std::int64_t parts,
               std::vector<std::int64_t>& ends) {
  if (parts <= 1) {
    std::sort(items.begin() + begin, items.begin() + end);
    ends.push_back(end);
    return;
  }
  const std::int64_t blocks = (end - begin + lanes - 1) / lanes, left = parts / 2;
  const std::int64_t middle = std::min(end, begin + blocks * left / parts * lanes);
  if (middle > begin && middle < end) bisect(items, centres, begin, middle, end);
  partition(items, centres, begin, middle, left, ends);
  partition(items, centres, middle, end, parts - left, ends);
}

std::vector<Point> tet_centres(const double* x, const std::int64_t* tets, std::int64_t count) {
  std::vector<Point> centres(count);
  for (std::int64_t t = 0; t < count; ++t) {
    for (int c = 0; c < 3; ++c) {
      centres[t][c] = 0;
      for (int k = 0; k < 4; ++k) centres[t][c] += 0.25 * x[3 * tets[4 * t + k] + c];
    }
  }
  return centres;
}

// Largest eigenvalue of a symmetric 3x3 matrix by Newton's method on its characteristic polynomial, from above (its trace).
double largest_eigenvalue(const Mat3<double>& a) {
  const Mat3<double> c = cofactor(a);
  const double trace = a.row[0].x + a.row[1].y + a.row[2].z;
  const double minors = c.row[0].x + c.row[1].y + c.row[2].z;
  const double det = dot(a.row[0], c.row[0]);
  double l = trace;
  for (int step = 0; step < 100; ++step) {
    const double p = ((l - trace) * l + minors) * l - det;
    const double slope = (3 * l - 2 * trace) * l + minors;
    const double change = slope > 0 ? p / slope : 0;
    l -= change;
    if (!(change > 1e-15 * trace)) break;
  }
  return l;
}

struct Rest {
  Mat3<double> inverse;
  double volume, bound;
};

Rest rest_of(const double* x, const std::int64_t* tet) {
  const auto at = [&](int k) {
    return Vec3<double>{x[3 * tet[k]], x[3 * tet[k] + 1], x[3 * tet[k] + 2]};
  };
  const Mat3<double> dm = from_columns(at(1) - at(0), at(2) - at(0), at(3) - at(0));
  const Mat3<double> adjoint = transpose(cofactor(dm));
  const double det = dot(dm.row[0], cofactor(dm).row[0]);
  const Mat3<double> inverse = (1 / det) * adjoint;
  const Vec3<double> n0 = -((inverse.row[0] + inverse.row[1]) + inverse.row[2]);
  return {inverse, det / 6,
          element_bound({{{n0.x, n0.y, n0.z},
                          {inverse.row[0].x, inverse.row[0].y, inverse.row[0].z},
                          {inverse.row[1].x, inverse.row[1].y, inverse.row[1].z},
                          {inverse.row[2].x, inverse.row[2].y, inverse.row[2].z}}})};
}

// Which vertices lie inside one patch, and which are shared; their new numbers.
struct Numbering {
  std::vector<std::int32_t> owner;      // first patch of each vertex, user's numbers
  std::vector<std::uint8_t> is_shared;  // user's numbers
  std::vector<std::int32_t> internal;   // user's number -> internal number
};

Numbering number_vertices(MeshPlan& plan, const std::int64_t* tets, std::int64_t vertices,
                          const std::vector<std::int32_t>& order,
                          const std::vector<std::int64_t>& ends) {
  Numbering n{std::vector<std::int32_t>(vertices, -1), std::vector<std::uint8_t>(vertices, 0),
              std::vector<std::int32_t>(vertices, -1)};
  std::vector<std::int64_t> by_owner;  // in order of first appearance
  by_owner.reserve(vertices);
  for (std::size_t p = 0; p < ends.size(); ++p) {
    for (std::int64_t i = p ? ends[p - 1] : 0; i < ends[p]; ++i) {
      for (int k = 0; k < 4; ++k) {
        const std::int64_t v = tets[4 * order[i] + k];
        if (n.owner[v] < 0) {
          n.owner[v] = std::int32_t(p);
          by_owner.push_back(v);
        } else if (n.owner[v] != std::int32_t(p)) {
          n.is_shared[v] = 1;
        }
      }
    }
  }
  plan.patch_vertex.assign(ends.size() + 1, 0);
  for (int shared = 0; shared < 2; ++shared) {
    for (const std::int64_t v : by_owner) {
      if (n.is_shared[v] != shared) continue;
      n.internal[v] = std::int32_t(plan.vertex_order.size());
      plan.vertex_order.push_back(std::int32_t(v));
      if (!shared) ++plan.patch_vertex[n.owner[v] + 1];
    }
  }
  std::partial_sum(plan.patch_vertex.begin(), plan.patch_vertex.end(), plan.patch_vertex.begin());
  return n;
}

// Slots of one patch: its interior vertices in their order, then the shared ones as they appear.
void add_slots(MeshPlan& plan, const Numbering& n, const std::int64_t* tets,
               const std::int32_t* first, const std::int32_t* last, std::int32_t patch,
               std::vector<std::int32_t>& slot_of) {
  const std::int32_t begin = plan.patch_slot.back();
  for (std::int32_t v = plan.patch_vertex[patch]; v < plan.patch_vertex[patch + 1]; ++v) {
    slot_of[plan.vertex_order[v]] = std::int32_t(plan.slot_vertex.size()) - begin;
    plan.slot_vertex.push_back(v);
  }
  for (const std::int32_t* t = first; t != last; ++t) {
    for (int k = 0; k < 4; ++k) {
      const std::int64_t v = tets[4 * std::int64_t(*t) + k];
      if (!n.is_shared[v] || slot_of[v] >= 0) continue;
      slot_of[v] = std::int32_t(plan.slot_vertex.size()) - begin;
      plan.slot_vertex.push_back(n.internal[v]);
    }
  }
  plan.patch_slot.push_back(std::int32_t(plan.slot_vertex.size()));
}

// Blocks of one patch. Neighbours go to different blocks, so that the lanes of a block seldom add to the same vertex.
void add_blocks(MeshPlan& plan, const double* x, const std::int64_t* tets,
                const std::int32_t* first, const std::int32_t* last,
                const std::vector<std::int32_t>& slot_of) {
  const std::int64_t count = last - first, blocks = (count + lanes - 1) / lanes;
  for (std::int64_t b = 0; b < blocks; ++b) {
    const std::size_t block = plan.tet_order.size() / lanes;
    plan.tet_order.resize((block + 1) * lanes);
    plan.tet_volume.resize((block + 1) * lanes);
    plan.tet_bound.resize((block + 1) * lanes);
    plan.tet_rest.resize((block + 1) * 9 * lanes);
    plan.tet_corner.resize((block + 1) * 4 * lanes);
    for (int lane = 0; lane < lanes; ++lane) {
      const std::int64_t i = lane * blocks + b;
      const std::int32_t t = first[std::min(i, count - 1)];
      const Rest rest = rest_of(x, tets + 4 * std::int64_t(t));
      plan.tet_order[block * lanes + lane] = t;
      plan.tet_volume[block * lanes + lane] = i < count ? rest.volume : 0;
      plan.tet_bound[block * lanes + lane] = rest.bound;
      for (int r = 0; r < 3; ++r) {
        const Vec3<double>& row = rest.inverse.row[r];
        const double entries[3] = {row.x, row.y, row.z};
        for (int c = 0; c < 3; ++c)
          plan.tet_rest[(block * 9 + 3 * r + c) * lanes + lane] = entries[c];
      }
      for (int k = 0; k < 4; ++k) {
        plan.tet_corner[(block * 4 + k) * lanes + lane] =
            std::int16_t(slot_of[tets[4 * std::int64_t(t) + k]]);
      }
    }
  }
  plan.patch_block.push_back(std::int32_t(plan.tet_order.size() / lanes));
}

// For every shared vertex the slots that hold it, in patch order.
void link_shared(MeshPlan& plan) {
  const std::int32_t first = plan.patch_vertex.back();
  plan.shared_start.assign(plan.vertex_order.size() - first + 1, 0);
  for (const std::int32_t v : plan.slot_vertex) {
    if (v >= first) ++plan.shared_start[v - first + 1];
  }
  std::partial_sum(plan.shared_start.begin(), plan.shared_start.end(), plan.shared_start.begin());
  plan.shared_slot.resize(plan.shared_start.back());
  std::vector<std::int32_t> next(plan.shared_start.begin(), plan.shared_start.end() - 1);
  for (std::size_t slot = 0; slot < plan.slot_vertex.size(); ++slot) {
    const std::int32_t v = plan.slot_vertex[slot];
    if (v >= first) plan.shared_slot[next[v - first]++] = std::int32_t(slot);
  }
}

}  // namespace

double element_bound(const std::array<std::array<double, 3>, 4>& gradients) {
  // the nonzero eigenvalues of S S^T, S the normalised gradients, are those of the 3x3 matrix S^T S
  Mat3<double> sum = {};
  for (const auto& g : gradients) {
    const Vec3<double> n = {g[0], g[1], g[2]};
    const Vec3<double> unit = (1 / std::sqrt(dot(n, n))) * n;
    sum = {{sum.row[0] + unit.x * unit, sum.row[1] + unit.y * unit, sum.row[2] + unit.z * unit}};
  }
  return largest_eigenvalue(sum);
}

MeshPlan build_plan(const double* positions, std::int64_t vertices, const std::int64_t* tets,
                    std::int64_t count, int patch_size,
                    const std::function<void(double)>& progress) {
  std::vector<std::int32_t> order(count);
  std::iota(order.begin(), order.end(), 0);
  std::vector<std::int64_t> ends;
  partition(order, tet_centres(positions, tets, count), 0, count,
            (count + patch_size - 1) / patch_size, ends);
  progress(0.3);

  MeshPlan plan;
  const Numbering numbering = number_vertices(plan, tets, vertices, order, ends);
  plan.patch_block.push_back(0);
  plan.patch_slot.push_back(0);
  std::vector<std::int32_t> slot_of(vertices, -1);
  for (std::size_t p = 0; p < ends.size(); ++p) {
    const std::int32_t *first = order.data() + (p ? ends[p - 1] : 0),
                       *last = order.data() + ends[p];
    add_slots(plan, numbering, tets, first, last, std::int32_t(p), slot_of);
    add_blocks(plan, positions, tets, first, last, slot_of);
    for (std::int32_t s = plan.patch_slot[p]; s < plan.patch_slot[p + 1]; ++s) {
      slot_of[plan.vertex_order[plan.slot_vertex[s]]] = -1;
    }
    if (p % 64 == 0) progress(0.3 + 0.7 * double(p) / double(ends.size()));
  }
  link_shared(plan);
  progress(1.0);
  return plan;
}

}  // namespace pd
