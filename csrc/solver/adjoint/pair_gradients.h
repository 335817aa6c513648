// Derivatives of a loss by what the pairs of a solved adjoint depend on, of one environment.
//
// The multipliers nu of the rows balance what the multiplier l of the step leaves of the right side:
//
//   C^T nu = P (dL/dx' + dL/dv' / h - a l - K l)     with all terms of planes and spheres of the scene
#pragma once
#include "solver/adjoint/pairs.h"

namespace pd::inline PD_TARGET {

template <class T, class Team>
class PairGradientsOf : public PairNodes<T, Team> {
 public:
  using Nodes = PairNodes<T, Team>;
  using typename Nodes::Place;

  // `pairs`: that are read
  PD_HD explicit PairGradientsOf(const Nodes& pairs) : Nodes(pairs) {}

  // From the multiplier l of the step and nu of the rows.
  template <class Read>
  PD_CALLED void find(const Read& read, double* nu, const PairGradients<T>& out) const {
    const int pairs = m_.counts->pairs;
    // in newtons and so on, from those of scaled rows
    team_.each(m_.counts->rows, [&](int p) { nu[p] *= sqrt(m_.item[m_.of_item[p]].step); });
    team_.each(4 * std::int64_t(pairs), [&](int n) {
      const PairItem& item = m_.item[n / 4];
      double l[12], end[3], start[3];
      gather(item, read, l);
      Place after[4], before[4];
      corners(item, after, before);
      for (int i = 0; i < 3; ++i) {
        const int j = 3 * (n % 4) + i;
        const PairSlope<double> slope(item.pair, after, before, false, j);
        end[i] = start[i] = 0;
        for (int c = 0; c < 12; ++c) {
          end[i] += item.slopes.load[c][j] * l[c];
          start[i] += slope.load[c] * l[c];
        }
        for (int k = 0; k < item.pair.rows(); ++k) {
          end[i] += item.slopes.row[k][j] * nu[m_.first[n / 4] + k];
          start[i] += slope.row[k] * nu[m_.first[n / 4] + k];
        }
      }
      m_.part[n] = {end[0], end[1], end[2]};
      m_.part_of_start[n] = {start[0], start[1], start[2]};
    });
    to_places(m_.part, call_.poses_after, out.end, out.poses_end);
    to_places(m_.part_of_start, call_.poses_before, out.start, out.poses_start);
    to_colliders(read, out);
    to_friction(read, out.friction + environment_ * plan_.bodies * plan_.bodies);
    team_.sums(
        1, pairs,
        [&](int, int n) {
          const PairItem& item = m_.item[n];
          return item.has_scene_thickness ? nu[m_.first[n]] : 0.0;
        },
        [&](int, double sum) { out.thickness[environment_] = T(sum); });
  }

 private:
  using Nodes::at, Nodes::corners, Nodes::gather, Nodes::sum_of;
  using Nodes::call_, Nodes::plan_, Nodes::order_, Nodes::team_, Nodes::m_;
  using Nodes::environment_, Nodes::count_;

  // Sums the parts of corners, by the places of bodies and the poses of colliders.
  PD_HD void to_places(const Vec3<double>* part, const T* poses, T* bodies, T* to) const {
    team_.each(count_, [&](int node) {
      const Place sum = sum_of(node, part);
      T* const own = bodies + 3 * (environment_ * count_ + order_[node]);
      own[0] = T(sum.x), own[1] = T(sum.y), own[2] = T(sum.z);
    });
    team_.sums(
        7 * std::int64_t(plan_.colliders), 4 * m_.counts->pairs,
        [&](int n, int k) {
          const int v = m_.item[k / 4].vertex[k % 4];
          return v < count_ ? 0.0 : by_pose(n, v, part[k], poses);
        },
        [&](int n, double sum) { to[7 * environment_ * plan_.colliders + n] = T(-sum); });
  }

  // By number n of the poses, from the place of one vertex. With u = axis x p a vertex is at
  // origin + p + 2 w u + 2 axis x u.
  PD_HD double by_pose(int n, int v, const Place& g, const T* poses) const {
    if (plan_.collider[v] != n / 7) return 0;
    const T* const pose = poses + 7 * (environment_ * plan_.colliders + plan_.collider[v]);
    const Place p = at(plan_.local + 3 * std::int64_t(v - count_)), axis = at(pose + 4),
                u = cross(axis, p);
    const double w(pose[3]);
    const Place turned = 2.0 * (w * cross(p, g) + cross(u, g) + cross(p, cross(g, axis)));
    const double own[7] = {g.x, g.y, g.z, 2 * dot(g, u), turned.x, turned.y, turned.z};
    return own[n % 7];
  }

  // By the inputs of colliders that leave their free motion; adds to what their poses at the start have.
  template <class Read>
  PD_HD void to_colliders(const Read& read, const PairGradients<T>& out) const {
    team_.each(plan_.rigid ? std::int64_t(rigid_inputs) * plan_.colliders : 0, [&](int n) {
      const int c = n / rigid_inputs, input = n % rigid_inputs, node = count_ + 2 * c;
      if (!(m_.inverse[node] > 0)) return;
      const std::int64_t at = environment_ * plan_.colliders + c;
      const double found = m_.rigid[c].gradient(input, read(node), read(node + 1));
      const int pose = input - rigid_numbers;
      if (pose < 0) {
        out.rigid[rigid_numbers * at + input] = T(found);
      } else {
        T& to = pose < 7 ? out.poses_free[7 * at + pose] : out.poses_start[7 * at + pose - 7];
        to = T(double(to) + found);
      }
    });
  }

  // f = lambda (n - mu s / |s|): column 0 of B less that of a smooth pair, over -mu
  template <class Read>
  PD_HD void to_friction(const Read& read, T* to) const {
    team_.each(m_.counts->pairs, [&](int number) {
      const PairItem& item = m_.item[number];
      double l[12], work = 0;
      gather(item, read, l);
      for (int a = 0; a < 4; ++a) {
        const Place normal = item.pair.frame.weight[a] * item.pair.frame.normal;
        work += l[3 * a] * (item.slopes.column[0][3 * a] - normal.x) +
                l[3 * a + 1] * (item.slopes.column[0][3 * a + 1] - normal.y) +
                l[3 * a + 2] * (item.slopes.column[0][3 * a + 2] - normal.z);
      }
      const bool slides = item.pair.state == PairState::slides;
      m_.along[number] = slides ? item.pair.normal_force * work / item.pair.friction : 0.0;
    });
    const std::int64_t tables = std::int64_t(plan_.bodies) * plan_.bodies;
    team_.each(tables, [&](int n) { m_.friction[n] = 0; });
    team_.once([&] {
      for (int n = 0; n < m_.counts->pairs; ++n) m_.friction[m_.item[n].bodies] += m_.along[n];
    });
    team_.each(tables, [&](int n) { to[n] = T(m_.friction[n]); });
  }
};

// `inverse`, `left`: memory for [vertices] of bodies
template <class T, class Team, class Provide>
PD_HD void differentiate_pairs(const PairGradientsCall<T>& call, const Team& team,
                               const PairMemory& memory, T* inverse, Vec3<double>* left,
                               const Provide& provide, std::int64_t environment) {
  const int vertices = call.vertices;
  const auto user = [&](int i) { return environment * vertices + call.vertex_order[i]; };
  const auto in_double = [](const T* p) {
    return Vec3<double>{double(p[0]), double(p[1]), double(p[2])};
  };
  const auto sliding = [&](int i) -> const T* {
    return call.sliding ? call.sliding + 3 * slide_count * user(i) : nullptr;
  };
  const auto projector = [&](int i) -> const T* {
    return call.projector ? call.projector + 9 * user(i) : nullptr;
  };
  team.each(vertices, [&](int i) {
    inverse[i] = call.inverse.of(environment)[call.vertex_order[i]];
    left[i] = {0, 0, 0};
  });
  AdjointPairs<T, Team> pairs(call.pairs, call.vertex_order, team, memory, environment);
  pairs.read([&](int i) -> T& { return inverse[i]; }, projector, sliding, provide);
  const auto multiplier = [&](int i) { return in_double(call.multiplier + 3 * user(i)); };
  pairs.multiply(false, multiplier, [&](int i, const Vec3<double>& a) { left[i] = a; });
  team.each(vertices, [&](int i) {
    double numbers[9], vectors[3 * slide_count];
    const T* const p = projector(i);
    for (int n = 0; p && n < 9; ++n) numbers[n] = double(p[n]);
    for (int n = 0; p && n < 3 * slide_count; ++n) vectors[n] = double(sliding(i)[n]);
    const Vec3<double> force = in_double(call.elastic + 3 * user(i)) + left[i];
    const bool moves = inverse[i] != T(0);
    const double inertia = double(call.inertia.of(environment)[call.vertex_order[i]]);
    const Vec3<double> l = multiplier(i), right = in_double(call.right + 3 * user(i));
    const Vec3<double> image =
        p ? friction_image<double>(force, project<double>(l, numbers), inertia, moves, numbers,
                                   vectors)
          : conjugate_image<double>(force, l, inertia, moves, nullptr, nullptr);
    left[i] = right - image;
  });
  double* const nu = pairs.rows().multipliers([&](int i) { return left[i]; });
  PairGradientsOf<T, Team>(pairs).find(multiplier, nu, call.out);
}

}  // namespace pd::inline PD_TARGET
