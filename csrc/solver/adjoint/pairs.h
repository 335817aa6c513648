// The loaded pairs of one environment in the adjoint of its step: see contact/pairs/curvature.h for
// one pair, and solver/adjoint/pair_rows.h for the directions that they leave.
//
// A projector and the vectors of sliding of a vertex that touches planes or spheres of the scene
// restrict its rows. Colliders with a mass that leave their free motion have nodes of their own:
// solver/adjoint/rigid_nodes.h.
#pragma once
#include "solver/adjoint/friction.h"
#include "solver/adjoint/pair_nodes.h"
#include "solver/adjoint/pair_rows.h"

namespace pd::inline PD_TARGET {

// `Team`: as OneThread
template <class T, class Team>
class AdjointPairs : public PairNodes<T, Team> {
 public:
  using Nodes = PairNodes<T, Team>;
  using typename Nodes::Place;

  // `vertex_order`: the user's numbers of the nodes
  PD_HD AdjointPairs(const LoadedPairs<T>& call, const int* vertex_order, const Team& team,
                     const PairMemory& memory, std::int64_t environment)
      : Nodes(call, vertex_order, team, memory, environment), rows_(team, memory, nodes_) {}

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

 private:
  using Nodes::at, Nodes::corners, Nodes::gather, Nodes::is_turn, Nodes::on_slot, Nodes::sum_of;
  using Nodes::call_, Nodes::plan_, Nodes::order_, Nodes::team_, Nodes::m_;
  using Nodes::environment_, Nodes::count_, Nodes::nodes_;

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

  PairRows<Team> rows_;
};

}  // namespace pd::inline PD_TARGET
