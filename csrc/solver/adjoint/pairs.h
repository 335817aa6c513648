// The loaded pairs of one environment in the adjoint of its step: see contact/pairs/curvature.h for
// one pair, and solver/adjoint/pair_rows.h for the directions that they leave.
//
// A projector and the vectors of sliding of a vertex that touches planes or spheres of the scene
// restrict its rows. Colliders with a mass that leave their free motion have nodes of their own:
// solver/adjoint/rigid_nodes.h.
#pragma once
#include "math/screw.h"
#include "solver/adjoint/friction.h"
#include "solver/adjoint/one_thread.h"
#include "solver/adjoint/pair_rows.h"
#include "solver/adjoint/pair_views.h"

namespace pd::inline PD_TARGET {

template <class T>
PD_HD PairSizes pair_sizes(const LoadedPairs<T>& call) {
  const ContactPlan<T>& plan = call.plan;
  return {plan.body_vertices, plan.rigid ? plan.colliders : 0, plan.capacity, call.most,
          plan.bodies};
}

// `Team`: as OneThread
template <class T, class Team>
class AdjointPairs {
 public:
  using Place = Vec3<double>;

  // `vertex_order`: the user's numbers of the nodes
  PD_HD AdjointPairs(const LoadedPairs<T>& call, const int* vertex_order, const Team& team,
                     const PairMemory& memory, std::int64_t environment)
      : call_(call),
        plan_(call.plan),
        order_(vertex_order),
        team_(team),
        m_(memory),
        environment_(environment),
        count_(call.plan.body_vertices),
        nodes_(int(pair_sizes(call).nodes())),
        rows_(team, memory, nodes_) {}

  // Reads the pairs. `inverse(i)`: a reference to 1 / D of a node, to whose D sliding pairs add.
  // `projector(i)`, `sliding(i)`: as in a ConjugateCall, or null. `provide(low, square)`: memory for
  // factors of such sizes.
  template <class Inverse, class Projector, class Sliding, class Provide>
  PD_CALLED void read(const Inverse& inverse, const Projector& projector, const Sliding& sliding,
                      const Provide& provide) {
    find(inverse);
    index();
    push_colliders(inverse);
    weigh(inverse);
    find_patches();
    team_.each(m_.counts->pairs, [&](int n) {
      for (int k = 0; k < m_.item[n].pair.rows(); ++k) write_row(n, k, projector, sliding);
    });
    rows_.factor(provide(m_.counts->low, m_.counts->square), repeated_row<T>,
                 m_.counts->skewed > 0);
  }

  PD_HD PairRows<Team>& rows() { return rows_; }
  PD_HD const PairRows<Team>& rows() const { return rows_; }
  // whether the matrix has other terms than that of the symmetric solve
  PD_HD bool some() const {
    for (int v = count_; v < nodes_; ++v)
      if (m_.inverse[v] > 0) return true;
    return m_.counts->pairs > 0;
  }

  // Visits visit(i, K^T l) for every node that moves; `read(i)`: l there. `positive`: the positive
  // part alone, the turn of slips and the inertia of colliders. Curvature of distances is negative
  // where corners meet.
  template <class Read, class Visit>
  PD_HD void multiply(bool positive, const Read& read, const Visit& visit) const {
    team_.each(4 * std::int64_t(m_.counts->pairs), [&](int n) {
      const PairItem& item = m_.item[n / 4];
      const auto& weight = item.pair.frame.weight;
      const int a = n % 4;
      m_.part[n] = {0, 0, 0};
      if (item.slot[a] < 0 || item.moves[item.slot[a]] < 0) return;
      double l[12];
      gather(item, read, l);
      if (positive) {
        double turned = 0;
        for (int b = 0; b < 4; ++b)
          turned +=
              weight[b] * dot(item.slopes.across, Place{l[3 * b], l[3 * b + 1], l[3 * b + 2]});
        m_.part[n] = (item.slopes.stiffness * weight[a] * turned) * item.slopes.across;
        return;
      }
      double product[3] = {0, 0, 0};
      for (int i = 0; i < 12; ++i)
        for (int j = 0; j < 3; ++j) product[j] += item.slopes.load[i][3 * a + j] * l[i];
      m_.part[n] = {product[0], product[1], product[2]};
    });
    team_.each(nodes_, [&](int v) {
      if (!(m_.inverse[v] > 0) || (v < count_ && m_.start[v] == m_.start[v + 1])) return;
      const Place sum = sum_of(v, m_.part);
      if (!is_turn(v)) return visit(v, sum);
      const RigidNode& own = m_.rigid[(v - count_) / 2];
      const Place z = read(v);
      visit(v, sum + (positive ? own.inertia * z : z * own.stiffness));
    });
  }

  // The derivatives that remain, from the multiplier l of the step and nu of the rows.
  template <class Read>
  PD_CALLED void differentiate(const Read& read, double* nu, const PairGradients<T>& out) const {
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
  // ---- the pairs

  PD_HD static Place at(const T* p) { return {double(p[0]), double(p[1]), double(p[2])}; }

  // of any vertex, by the places of bodies and the poses of colliders
  PD_HD Place place(int v, const T* bodies, const T* poses) const {
    if (v < count_) return at(bodies + 3 * (environment_ * count_ + v));
    const T* const pose = poses + 7 * (environment_ * plan_.colliders + plan_.collider[v]);
    return Pose<double>{at(pose), double(pose[3]), at(pose + 4)}.place(
        at(plan_.local + 3 * std::int64_t(v - count_)));
  }

  PD_HD void corners(const PairItem& item, Place (&after)[4], Place (&before)[4]) const {
    for (int a = 0; a < 4; ++a) {
      after[a] = place(item.vertex[a], call_.after, call_.poses_after);
      before[a] = place(item.vertex[a], call_.before, call_.poses_before);
    }
  }

  template <class Read>
  PD_HD void gather(const PairItem& item, const Read& read, double (&l)[12]) const {
    for (int a = 0; a < 4; ++a) {
      Place of = {0, 0, 0};
      if (const int s = item.slot[a]; s >= 0) {
        of = read(item.node[s]);
        if (item.node[s] >= count_) of = of + cross(read(item.node[s + 1]), item.arm[a]);
      }
      l[3 * a] = of.x, l[3 * a + 1] = of.y, l[3 * a + 2] = of.z;
    }
  }

  PD_HD bool is_turn(int node) const { return node >= count_ && (node - count_) % 2 != 0; }

  // What forces at(corner) are on a slot.
  template <class At>
  PD_HD Place on_slot(const PairItem& item, int s, const At& at) const {
    const int node = item.node[s], first = item.corner[s];
    if (node < count_) return at(first);
    const int end = first > 0 ? 4 : item.pair.edges ? 2 : 1;
    Place sum = {0, 0, 0};
    for (int a = first; a < end; ++a)
      sum = sum + (is_turn(node) ? cross(item.arm[a], at(a)) : at(a));
    return sum;
  }
  PD_HD double slot_weight(const PairItem& item, int s) const {
    if (item.node[s] < count_) return absolute(item.pair.frame.weight[item.corner[s]]);
    // of all directions: arms turn to any
    Place sum = {0, 0, 0};
    const int first = item.corner[s], end = first > 0 ? 4 : item.pair.edges ? 2 : 1;
    for (int a = first; a < end; ++a) sum = sum + item.pair.frame.weight[a] * item.arm[a];
    return is_turn(item.node[s]) ? square_root(dot(sum, sum)) : 1.0;
  }

  // Sum of |w| at a vertex: of all corners of a body's node, or of one vertex of a collider.
  PD_HD double spread_of(int node, int vertex) const {
    double sum = 0;
    for (int n = m_.start[node]; n < m_.start[node + 1]; ++n) {
      const PairItem& item = m_.item[m_.entry[n] / m_.slots];
      const int s = m_.entry[n] % m_.slots;
      if (vertex < 0) sum += absolute(item.pair.frame.weight[item.corner[s]]);
      for (int a = 0; vertex >= 0 && a < 4; ++a)
        if (item.vertex[a] == vertex) sum += absolute(item.pair.frame.weight[a]);
    }
    return sum;
  }

  PD_HD Place sum_of(int node, const Vec3<double>* part) const {
    Place sum = {0, 0, 0};
    for (int n = m_.start[node]; n < m_.start[node + 1]; ++n) {
      const int number = m_.entry[n] / m_.slots;
      sum = sum + on_slot(m_.item[number], m_.entry[n] % m_.slots,
                          [&](int a) { return part[4 * number + a]; });
    }
    return sum;
  }

  // Fills the items, in the order of the keys.
  template <class Inverse>
  PD_HD void find(const Inverse& inverse) {
    team_.each(plan_.capacity, [&](int n) {
      const std::int64_t row = environment_ * plan_.capacity + n;
      m_.slot[n] = call_.keys[row] >= 0 && call_.forces[4 * row] > T(0);
    });
    team_.each(count_, [&](int i) { m_.internal[order_[i]] = i; });
    team_.each(plan_.rigid ? plan_.colliders : 0, [&](int c) {
      const std::int64_t at = environment_ * plan_.colliders + c;
      if (inverse(count_ + 2 * c) > T(0))
        m_.rigid[c].set(plan_.rigid + rigid_numbers * at, call_.poses_before + 7 * at,
                        call_.poses_after + 7 * at, call_.poses_free + 7 * at);
    });
    team_.scan(m_.slot, plan_.capacity);
    team_.once([&] { m_.counts->pairs = m_.slot[plan_.capacity]; });
    team_.each(plan_.capacity, [&](int n) {
      if (m_.slot[n + 1] > m_.slot[n]) set(m_.item[m_.slot[n]], n, inverse);
    });
    team_.each(12 * std::int64_t(m_.counts->pairs), [&](int n) {
      PairItem& item = m_.item[n / 12];
      Place after[4], before[4];
      corners(item, after, before);
      item.slopes.differentiate(item.pair, after, before, n % 12);
    });
  }

  template <class Inverse>
  PD_HD void set(PairItem& item, int number, const Inverse& inverse) const {
    const std::int64_t row = environment_ * plan_.capacity + number, key = call_.keys[row],
                       first_edge = std::int64_t(plan_.vertices) * plan_.triangles;
    const T* f = call_.forces + 4 * row;
    const bool edges = key >= first_edge;
    if (edges) {
      const std::int64_t pair = key - first_edge;
      for (int a = 0; a < 2; ++a) {
        item.vertex[a] = plan_.edge[2 * (pair / plan_.edges) + a];
        item.vertex[2 + a] = plan_.edge[2 * (pair % plan_.edges) + a];
      }
    } else {
      item.vertex[0] = int(key / plan_.triangles);
      for (int a = 0; a < 3; ++a)
        item.vertex[1 + a] = plan_.triangle[3 * (key % plan_.triangles) + a];
    }
    const int first = plan_.body[item.vertex[0]], last = plan_.body[item.vertex[3]];
    item.bodies = first * plan_.bodies + last;
    item.has_scene_thickness = first != last || !is_close_at_rest(key);
    Place after[4], before[4];
    corners(item, after, before);
    double weights[4];
    int slots = 0;
    const auto add_slot = [&](int node, int corner) {
      item.node[slots] = node;
      item.corner[slots] = corner;
      item.moves[slots] = inverse(node) > T(0) ? node : -1;
      return slots++;
    };
    for (int a = 0; a < 4; ++a) {
      const int v = item.vertex[a];
      item.arm[a] = {0, 0, 0};
      item.slot[a] = -1;
      weights[a] = 0;
      if (v < count_) {
        item.slot[a] = add_slot(m_.internal[v], a);
        weights[a] = double(inverse(m_.internal[v]));
        continue;
      }
      const int node = count_ + 2 * plan_.collider[v];
      if (!plan_.rigid || !(inverse(node) > T(0))) continue;
      if (a == 0 || a == (edges ? 2 : 1)) {
        add_slot(node, a);
        add_slot(node + 1, a);
      }
      const RigidNode& own = m_.rigid[plan_.collider[v]];
      item.slot[a] = slots - 2;
      item.arm[a] = (1 / own.size) * (after[a] - own.center);
      weights[a] = rigid_yield / own.at.weight();
    }
    for (; slots < most_slots; ++slots) item.node[slots] = item.moves[slots] = -1;
    const T* const friction = plan_.friction + environment_ * plan_.friction_stride;
    item.pair = loaded_pair(edges, after, before, weights, double(friction[item.bodies]),
                            double(f[0]), Place{double(f[1]), double(f[2]), double(f[3])});
    item.slopes.set(item.pair, after, before);
  }

  PD_HD bool is_close_at_rest(std::int64_t key) const {
    std::int64_t begin = 0, end = plan_.rest_pairs;
    while (begin < end) {
      const std::int64_t middle = (begin + end) / 2;
      (plan_.rest_key[middle] < key ? begin : end) =
          plan_.rest_key[middle] < key ? middle + 1 : middle;
    }
    return begin < plan_.rest_pairs && plan_.rest_key[begin] == key;
  }

  // Slots of every node, in the order of the items.
  PD_HD void index() {
    const int slots = m_.slots, all = slots * m_.counts->pairs;
    const auto node = [&](int n) { return m_.item[n / slots].node[n % slots]; };
    team_.each(nodes_, [&](int v) { m_.start[v] = 0; });
    team_.each(all, [&](int n) {
      if (node(n) >= 0) team_.add(m_.start + node(n), 1);
    });
    team_.scan(m_.start, nodes_);
    team_.each(nodes_, [&](int v) { m_.cursor[v] = m_.start[v]; });
    team_.each(all, [&](int n) {
      if (node(n) >= 0) m_.entry[team_.add(m_.cursor + node(n), 1)] = n;
    });
    // they came in the order of threads
    team_.each(nodes_, [&](int v) {
      for (int n = m_.start[v] + 1; n < m_.start[v + 1]; ++n) {
        const int own = m_.entry[n];
        int to = n;
        for (; to > m_.start[v] && m_.entry[to - 1] > own; --to) m_.entry[to] = m_.entry[to - 1];
        m_.entry[to] = own;
      }
    });
  }

  // Adds the forces of pairs to the stiffness of the turns of colliders.
  template <class Inverse>
  PD_HD void push_colliders(const Inverse& inverse) {
    team_.each(plan_.rigid ? plan_.colliders : 0, [&](int c) {
      const int node = count_ + 2 * c + 1;
      if (!(inverse(node) > T(0))) return;
      for (int n = m_.start[node]; n < m_.start[node + 1]; ++n) {
        const PairItem& item = m_.item[m_.entry[n] / m_.slots];
        on_slot(item, m_.entry[n] % m_.slots, [&](int a) {
          m_.rigid[c].push(item.arm[a], -item.pair.frame.weight[a] * item.slopes.force);
          return item.arm[a];
        });
      }
    });
  }

  // Steps of the pairs, those of the sweeps; adds to D the stiffness by which the slips turn.
  template <class Inverse>
  PD_HD void weigh(const Inverse& inverse) {
    team_.each(count_, [&](int v) { m_.spread[v] = spread_of(v, -1); });
    team_.each(m_.counts->pairs, [&](int n) {
      PairItem& item = m_.item[n];
      double yielding = 0;
      for (int a = 0; a < 4; ++a) {
        const int v = item.slot[a] < 0 ? -1 : item.node[item.slot[a]];
        if (v < 0) continue;
        const double own = v < count_ ? m_.spread[v] * double(inverse(v))
                                      : spread_of(v, item.vertex[a]) * rigid_yield /
                                            m_.rigid[(v - count_) / 2].at.weight();
        yielding += absolute(item.pair.frame.weight[a]) * own;
      }
      item.step = yielding > 0 ? 1 / yielding : 0.0;
    });
    team_.each(nodes_, [&](int v) {
      double more = 0;
      for (int n = m_.start[v]; n < m_.start[v + 1]; ++n) {
        const PairItem& item = m_.item[m_.entry[n] / m_.slots];
        const double weight = slot_weight(item, m_.entry[n] % m_.slots);
        more += item.slopes.stiffness * weight * weight;
      }
      T& own = inverse(v);
      if (more > 0 && own > T(0)) own = T(1 / (1 / double(own) + more));
      m_.inverse[v] = double(own);
    });
  }

  // Numbers the rows patch by patch. A label is the first item of a patch; every round passes labels
  // on through the vertices, and each takes that of the item that its label names.
  PD_HD void find_patches() {
    const int pairs = m_.counts->pairs;
    team_.each(pairs, [&](int n) { m_.label[n] = n; });
    for (;;) {
      team_.once([&] { m_.counts->changed = 0; });
      team_.each(nodes_, [&](int v) {
        int least = pairs;
        if (m_.inverse[v] > 0) {
          for (int n = m_.start[v]; n < m_.start[v + 1]; ++n)
            least = min_of(least, m_.label[m_.entry[n] / m_.slots]);
        }
        m_.least[v] = least;
      });
      team_.each(pairs, [&](int n) {
        int least = m_.label[n];
        for (int v : m_.item[n].moves) least = v < 0 ? least : min_of(least, m_.least[v]);
        m_.other[n] = least;
      });
      team_.each(pairs, [&](int n) {
        const int to = m_.other[m_.other[n]];
        if (to != m_.label[n]) team_.add(&m_.counts->changed, 1);
        m_.label[n] = to;
      });
      const bool changed = m_.counts->changed > 0;
      team_.barrier();
      if (!changed) break;
    }
    team_.each(pairs, [&](int n) { m_.size[n] = m_.other[n] = 0; });
    team_.each(nodes_, [&](int v) {
      if (m_.least[v] < pairs) team_.add(m_.other + m_.least[v], 1);
    });
    team_.each(pairs, [&](int n) { team_.add(m_.size + m_.label[n], m_.item[n].pair.rows()); });
    team_.once([&] { number_rows(); });
  }

  // `size`, `other`: rows and nodes of the patch that an item names
  PD_HD void number_rows() {
    int rows = 0, patches = 0;
    std::int64_t low = 0, square = 0;
    const int pairs = m_.counts->pairs;
    for (int n = 0; n < pairs; ++n) {
      if (m_.label[n] == n) {
        const std::int64_t own = m_.size[n], rank = min_of(own, 3 * std::int64_t(m_.other[n]));
        m_.patch[patches++] = {rows, rows + int(own), 0, 0, 0, 0};
        m_.size[n] = rows;
        rows += int(own);
        low += own * rank;
        square += rank * rank;
      }
      m_.first[n] = m_.size[m_.label[n]];
      m_.end[n] = m_.size[m_.label[n]] += m_.item[n].pair.rows();
    }
    m_.counts->rows = rows;
    m_.counts->patches = patches;
    m_.counts->low = low;
    m_.counts->square = square;
    m_.counts->skewed = 0;
  }

  template <class I>
  PD_HD static I min_of(I a, I b) {
    return b < a ? b : a;
  }

  template <class Projector, class Sliding>
  PD_HD void write_row(int number, int k, const Projector& projector, const Sliding& sliding) {
    const PairItem& item = m_.item[number];
    const double scale = sqrt(item.step);
    const int p = m_.first[number] + k;
    const std::int64_t at_slots = std::int64_t(m_.slots) * p;
    bool skewed = item.pair.state != PairState::smooth;
    m_.of_item[p] = number;
    for (int n = 0; n < m_.slots; ++n) {
      const int v = item.moves[n];
      Place &held = m_.held[at_slots + n], &pushed = m_.pushed[at_slots + n];
      m_.moves[at_slots + n] = v;
      held = pushed = {0, 0, 0};
      if (v < 0) continue;
      const auto part = [&](const double (&from)[12]) {
        return scale * on_slot(item, n, [&](int a) {
                 return Place{from[3 * a], from[3 * a + 1], from[3 * a + 2]};
               });
      };
      pushed = part(item.slopes.column[k]);
      if (const T* s = sliding(v)) {
        skewed = skewed || slides(s);
        pushed = pushed + dot(pushed, at(s + 3 * slide_normal)) * at(s + 3 * slide_along);
      }
      held = projected(part(item.slopes.row[k]), projector(v));
      pushed = projected(pushed, projector(v));
    }
    if (skewed) team_.add(&m_.counts->skewed, 1);
  }

  PD_HD static Place projected(const Place& field, const T* p) {
    if (!p) return field;
    return Mat3<double>{{at(p), at(p + 3), at(p + 6)}} * field;
  }

  // ---- gradients

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

  const LoadedPairs<T>& call_;
  const ContactPlan<T>& plan_;
  const int* order_;
  const Team& team_;
  const PairMemory& m_;
  std::int64_t environment_;
  int count_, nodes_;  // vertices of bodies; all
  PairRows<Team> rows_;
};

}  // namespace pd::inline PD_TARGET
