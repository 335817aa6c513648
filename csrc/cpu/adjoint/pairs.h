// The loaded pairs of one environment in the adjoint of its step: see contact/pairs/curvature.h for
// one pair, and cpu/adjoint/pair_rows.h for the directions that they leave.
//
// Vertices of bodies have the internal numbers of a plan, those of colliders -1. A projector and the
// vectors of sliding of a vertex that touches planes or spheres of the scene restrict its rows.
#pragma once
#include "contact/pairs/curvature.h"
#include "cpu/adjoint/pair_rows.h"
#include "cpu/adjoint/pair_views.h"
#include "math/screw.h"
#include "solver/adjoint/friction.h"

#include <cstdint>
#include <vector>

namespace pd::inline PD_TARGET {

template <class T>
class AdjointPairs {
 public:
  using Place = Vec3<double>;

  // A pair, its multipliers and the derivatives by the corners at the end.
  struct Item {
    int vertex[4], inside[4];  // of all vertices, and of the plan
    LoadedPair<double> pair;
    PairSlopes<double> slopes;
    double step;  // of its multipliers in a sweep
    int first_row;
    int bodies;  // place in the table of friction
    bool has_scene_thickness;
  };

  AdjointPairs(const LoadedPairs<T>& call, const int* vertex_order, int count)
      : call_(call),
        count_(count),
        inside_(call.plan.vertices, -1),
        begin_(call.plan.vertices),
        end_(call.plan.vertices),
        sum_(count, Place{0, 0, 0}) {
    for (int i = 0; i < count; ++i) inside_[vertex_order[i]] = i;
  }

  // Reads the pairs of an environment. `inverse(i)`: a reference to 1 / D of a vertex, to whose D
  // sliding pairs add. `projector(i)`, `sliding(i)`: as in a ConjugateCall, or null.
  template <class Inverse, class Projector, class Sliding>
  void read(std::int64_t environment, const Inverse& inverse, const Projector& projector,
            const Sliding& sliding) {
    place(environment);
    find(environment, inverse);
    raise(inverse);
    rows_.clear(count_);
    for (int i = 0; i < count_; ++i) rows_.inverse(i) = double(inverse(i));
    int rows = 0;
    for (Item& item : items_) {
      item.first_row = rows;
      for (int k = 0; k < item.pair.rows(); ++k, ++rows) add_row(item, k, projector, sliding);
    }
    rows_.factor(repeated_row<T>);
    touched_.clear();
    std::vector<char> seen(count_, 0);
    for (const Item& item : items_) {
      for (int i : item.inside) {
        if (i < 0 || seen[i] || !(rows_.inverse(i) > 0)) continue;
        seen[i] = 1;
        touched_.push_back(i);
      }
    }
  }

  PairRows& rows() { return rows_; }
  const std::vector<Item>& items() const { return items_; }
  const std::vector<Place>& begin() const { return begin_; }
  const std::vector<Place>& end() const { return end_; }
  bool some() const { return !items_.empty(); }

  // Visits visit(i, K^T l) for every vertex that moves; `read(i)`: l there. `positive`: the positive part alone, the turn
  // of slips. Curvature of distances is negative where corners meet.
  template <class Read, class Visit>
  void multiply(bool positive, const Read& read, const Visit& visit) {
    for (int i : touched_) sum_[i] = {0, 0, 0};
    for (const Item& item : items_) {
      double l[12];
      gather(item, read, l);
      const auto& weight = item.pair.frame.weight;
      double turned = 0;
      for (int a = 0; positive && a < 4; ++a)
        turned += weight[a] * dot(item.slopes.across, Place{l[3 * a], l[3 * a + 1], l[3 * a + 2]});
      for (int a = 0; a < 4; ++a) {
        const int v = item.inside[a];
        if (v < 0) continue;
        double product[3] = {0, 0, 0};
        for (int j = 0; !positive && j < 3; ++j)
          for (int i = 0; i < 12; ++i) product[j] += item.slopes.load[i][3 * a + j] * l[i];
        const Place own = positive
                              ? (item.slopes.stiffness * weight[a] * turned) * item.slopes.across
                              : Place{product[0], product[1], product[2]};
        sum_[v] = sum_[v] + own;
      }
    }
    for (int i : touched_) visit(i, sum_[i]);
  }

  // The derivatives that remain, from the multiplier l of the step and nu of the rows, by the numbers of all vertices.
  template <class Read>
  void differentiate(std::int64_t environment, const Read& read, const std::vector<double>& nu,
                     const PairGradients<T>& out) const {
    const ContactPlan<T>& plan = call_.plan;
    std::vector<Place> end(plan.vertices, Place{0, 0, 0}), start(end);
    std::vector<double> friction(std::size_t(plan.bodies) * plan.bodies, 0.0);
    double thickness = 0;
    for (const Item& item : items_) {
      double l[12];
      gather(item, read, l);
      Place after[4], before[4];
      corners(item, after, before);
      double load[12][12], row[3][12];
      PairSlopes<double>::differentiate(item.pair, after, before, false, load, row);
      add(item, item.slopes.load, item.slopes.row, l, nu, end);
      add(item, load, row, l, nu, start);
      if (item.has_scene_thickness) thickness += nu[item.first_row];
      if (item.pair.state != PairState::slides) continue;
      // f = lambda (n - mu s / |s|): column 0 of B less that of a smooth pair, over -mu
      double work = 0;
      for (int a = 0; a < 4; ++a) {
        const Place normal = item.pair.frame.weight[a] * item.pair.frame.normal;
        work += l[3 * a] * (item.slopes.column[0][3 * a] - normal.x) +
                l[3 * a + 1] * (item.slopes.column[0][3 * a + 1] - normal.y) +
                l[3 * a + 2] * (item.slopes.column[0][3 * a + 2] - normal.z);
      }
      friction[item.bodies] += item.pair.normal_force * work / item.pair.friction;
    }
    for (int v = 0; v < plan.body_vertices; ++v) {
      write(end[v], out.end + 3 * (environment * plan.body_vertices + v));
      write(start[v], out.start + 3 * (environment * plan.body_vertices + v));
    }
    to_poses(environment, end, call_.poses_after, out.poses_end);
    to_poses(environment, start, call_.poses_before, out.poses_start);
    for (std::size_t n = 0; n < friction.size(); ++n)
      out.friction[environment * friction.size() + n] = T(friction[n]);
    out.thickness[environment] = T(thickness);
  }

  // The multipliers of all rows in newtons and so on, from those of scaled rows.
  std::vector<double> unscaled(std::vector<double> nu) const {
    for (const Item& item : items_)
      for (int k = 0; k < item.pair.rows(); ++k) nu[item.first_row + k] *= std::sqrt(item.step);
    return nu;
  }

 private:
  // Gradients for poses, less those for the places of their vertices. With u = axis x p a vertex is at
  // origin + p + 2 w u + 2 axis x u.
  void to_poses(std::int64_t environment, const std::vector<Place>& places, const T* poses,
                T* out) const {
    const ContactPlan<T>& plan = call_.plan;
    std::vector<double> sums(7 * std::size_t(plan.colliders), 0.0);
    for (int v = plan.body_vertices; v < plan.vertices; ++v) {
      const T* pose = poses + 7 * (environment * plan.colliders + plan.collider[v]);
      const T* local = plan.local + 3 * std::int64_t(v - plan.body_vertices);
      const Place p = {double(local[0]), double(local[1]), double(local[2])},
                  axis = {double(pose[4]), double(pose[5]), double(pose[6])}, g = places[v],
                  u = cross(axis, p);
      const double w(pose[3]);
      const Place turned = 2.0 * (w * cross(p, g) + cross(u, g) + cross(p, cross(g, axis)));
      const double own[7] = {g.x, g.y, g.z, 2 * dot(g, u), turned.x, turned.y, turned.z};
      for (int n = 0; n < 7; ++n) sums[7 * plan.collider[v] + n] -= own[n];
    }
    for (std::size_t n = 0; n < sums.size(); ++n) out[environment * sums.size() + n] = T(sums[n]);
  }

  static void write(const Place& from, T* to) {
    to[0] = T(from.x), to[1] = T(from.y), to[2] = T(from.z);
  }

  template <class Read>
  void gather(const Item& item, const Read& read, double (&l)[12]) const {
    for (int a = 0; a < 4; ++a) {
      const Place at = item.inside[a] >= 0 ? read(item.inside[a]) : Place{0, 0, 0};
      l[3 * a] = at.x, l[3 * a + 1] = at.y, l[3 * a + 2] = at.z;
    }
  }

  void add(const Item& item, const double (&load)[12][12], const double (&row)[3][12],
           const double (&l)[12], const std::vector<double>& nu, std::vector<Place>& to) const {
    double sum[12];
    for (int j = 0; j < 12; ++j) {
      sum[j] = 0;
      for (int i = 0; i < 12; ++i) sum[j] += load[i][j] * l[i];
      for (int k = 0; k < item.pair.rows(); ++k) sum[j] += row[k][j] * nu[item.first_row + k];
    }
    for (int a = 0; a < 4; ++a)
      to[item.vertex[a]] = to[item.vertex[a]] + Place{sum[3 * a], sum[3 * a + 1], sum[3 * a + 2]};
  }

  // Places of all vertices at the start and at the end of the step.
  void place(std::int64_t environment) {
    const ContactPlan<T>& plan = call_.plan;
    const auto at = [](const T* p) { return Place{double(p[0]), double(p[1]), double(p[2])}; };
    for (int v = 0; v < plan.body_vertices; ++v) {
      const std::int64_t row = 3 * (environment * plan.body_vertices + v);
      begin_[v] = at(call_.before + row);
      end_[v] = at(call_.after + row);
    }
    for (int v = plan.body_vertices; v < plan.vertices; ++v) {
      const std::int64_t row = 7 * (environment * plan.colliders + plan.collider[v]);
      const Place local = at(plan.local + 3 * std::int64_t(v - plan.body_vertices));
      const auto placed = [&](const T* p) {
        return Pose<double>{at(p), double(p[3]), at(p + 4)}.place(local);
      };
      begin_[v] = placed(call_.poses_before + row);
      end_[v] = placed(call_.poses_after + row);
    }
  }

  void corners(const Item& item, Place (&after)[4], Place (&before)[4]) const {
    for (int a = 0; a < 4; ++a) {
      after[a] = end_[item.vertex[a]];
      before[a] = begin_[item.vertex[a]];
    }
  }

  template <class Inverse>
  void find(std::int64_t environment, const Inverse& inverse) {
    const ContactPlan<T>& plan = call_.plan;
    const std::int64_t first_edge = std::int64_t(plan.vertices) * plan.triangles;
    items_.clear();
    for (int n = 0; n < plan.capacity; ++n) {
      const std::int64_t row = environment * plan.capacity + n, key = call_.keys[row];
      if (key < 0) break;
      const T* f = call_.forces + 4 * row;
      if (!(f[0] > T(0))) continue;
      Item item;
      const bool edges = key >= first_edge;
      if (edges) {
        const std::int64_t pair = key - first_edge;
        for (int a = 0; a < 2; ++a) {
          item.vertex[a] = plan.edge[2 * (pair / plan.edges) + a];
          item.vertex[2 + a] = plan.edge[2 * (pair % plan.edges) + a];
        }
      } else {
        item.vertex[0] = int(key / plan.triangles);
        for (int a = 0; a < 3; ++a)
          item.vertex[1 + a] = plan.triangle[3 * (key % plan.triangles) + a];
      }
      double weights[4];
      for (int a = 0; a < 4; ++a) {
        item.inside[a] = inside_[item.vertex[a]];
        weights[a] = item.inside[a] >= 0 ? double(inverse(item.inside[a])) : 0.0;
      }
      const int first = plan.body[item.vertex[0]], last = plan.body[item.vertex[3]];
      item.bodies = first * plan.bodies + last;
      item.has_scene_thickness =
          first != last || !std::binary_search(plan.rest_key, plan.rest_key + plan.rest_pairs, key);
      Place after[4], before[4];
      corners(item, after, before);
      item.pair = loaded_pair(edges, after, before, weights, double(plan.friction[item.bodies]),
                              double(f[0]), Place{double(f[1]), double(f[2]), double(f[3])});
      item.slopes.set(item.pair, after, before);
      items_.push_back(item);
    }
    std::vector<double> sums(count_, 0.0);
    for (const Item& item : items_)
      for (int a = 0; a < 4; ++a)
        if (item.inside[a] >= 0) sums[item.inside[a]] += std::abs(item.pair.frame.weight[a]);
    for (Item& item : items_) {
      double yielding = 0;
      for (int a = 0; a < 4; ++a)
        if (item.inside[a] >= 0)
          yielding += std::abs(item.pair.frame.weight[a]) * sums[item.inside[a]] *
                      double(inverse(item.inside[a]));
      item.step = yielding > 0 ? 1 / yielding : 0.0;
    }
  }

  // Adds to D the stiffness by which the slip of a pair turns.
  template <class Inverse>
  void raise(const Inverse& inverse) {
    std::vector<double> more(count_, 0.0);
    for (const Item& item : items_)
      for (int a = 0; a < 4; ++a)
        if (item.inside[a] >= 0)
          more[item.inside[a]] +=
              item.slopes.stiffness * item.pair.frame.weight[a] * item.pair.frame.weight[a];
    for (int i = 0; i < count_; ++i)
      if (more[i] > 0 && inverse(i) > T(0)) inverse(i) = T(1 / (1 / double(inverse(i)) + more[i]));
  }

  template <class Projector, class Sliding>
  void add_row(const Item& item, int k, const Projector& projector, const Sliding& sliding) {
    const double scale = std::sqrt(item.step);
    PairRow row;
    for (int a = 0; a < 4; ++a) {
      const int i = item.inside[a];
      row.vertex[a] = i >= 0 && rows_.inverse(i) > 0 ? i : -1;
      row.held[a] = row.pushed[a] = {0, 0, 0};
      if (row.vertex[a] < 0) continue;
      const auto part = [&](const double (&from)[12]) {
        return scale * Place{from[3 * a], from[3 * a + 1], from[3 * a + 2]};
      };
      Place pushed = part(item.slopes.column[k]);
      if (const T* s = sliding(i)) {
        const T *along = s + 3 * slide_along, *normal = s + 3 * slide_normal;
        const Place n = {double(normal[0]), double(normal[1]), double(normal[2])};
        pushed =
            pushed + dot(pushed, n) * Place{double(along[0]), double(along[1]), double(along[2])};
      }
      row.held[a] = projected(part(item.slopes.row[k]), projector(i));
      row.pushed[a] = projected(pushed, projector(i));
    }
    rows_.add(row, item.pair.state != PairState::smooth);
  }

  static Place projected(const Place& field, const T* p) {
    if (!p) return field;
    double numbers[9];
    for (int n = 0; n < 9; ++n) numbers[n] = double(p[n]);
    return pd::project(field, static_cast<const double*>(numbers));
  }

  const LoadedPairs<T>& call_;
  int count_;                // vertices of bodies
  std::vector<int> inside_;  // internal numbers of all vertices
  std::vector<Place> begin_, end_, sum_;
  std::vector<Item> items_;
  std::vector<int> touched_;  // internal numbers of vertices of pairs that move
  PairRows rows_;
};

}  // namespace pd::inline PD_TARGET
