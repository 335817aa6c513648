// The pairs of one environment: their search, planes, and what each vertex finds in them.
#pragma once
#include "contact/pairs/pair.h"
#include "cpu/contact/tree.h"

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace pd::inline PD_TARGET {

// Finds pairs in the order of their keys: vertices and triangles by vertex, then edges by the first.
template <class T>
class PairSearch {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit PairSearch(const ContactPlan<T>& plan)
      : plan_(plan),
        points_(plan.point_order, plan.points),
        triangles_(plan.triangle_order, plan.triangles),
        edges_(plan.edge_order, plan.edges) {}

  // Calls visit(pair) for every pair that counts and whose boxes meet. `box_of(vertex)`: of a vertex;
  // `reach(vertex)`: by which boxes of its sides are wider. `held(vertex)`: moves by hand.
  template <class BoxOf, class Reach, class Held, class Visit>
  void each_boxed(const BoxOf& box_of, const Reach& reach, const Held& held, const Visit& visit) {
    const auto side = [&](const int* vertex, int count) {
      Box<T> box = Box<T>::none();
      T widest(0);
      for (int a = 0; a < count; ++a) {
        box.add(box_of(vertex[a]));
        widest = std::max(widest, reach(vertex[a]));
      }
      return box.widened(widest);
    };
    triangles_.refit([&](int n) { return side(plan_.triangle + 3 * n, 3); });
    edges_.refit([&](int n) { return side(plan_.edge + 2 * n, 2); });
    for (int n = 0; n < plan_.points; ++n) {
      const int vertex = plan_.point[n];
      each_partner(triangles_, side(&vertex, 1), -1, [&](int triangle) {
        emit(pair_of_point(plan_, vertex, triangle), held, visit);
      });
    }
    for (int n = 0; n < plan_.edges; ++n) {
      const int* a = plan_.edge + 2 * n;
      each_partner(edges_, side(a, 2), n,
                   [&](int other) { emit(pair_of_edges(plan_, n, other), held, visit); });
    }
  }

 private:
  template <class Visit>
  void each_partner(const BoxTree<T>& tree, const Box<T>& box, int least, const Visit& visit) {
    partners_.clear();
    tree.each_near(box, [&](int number) {
      if (number > least) partners_.push_back(number);
    });
    std::sort(partners_.begin(), partners_.end());
    for (int number : partners_) visit(number);
  }

  template <class Held, class Visit>
  void emit(ContactPair<T> pair, const Held& held, const Visit& visit) const {
    if (complete(plan_, held, pair)) visit(pair);
  }

  const ContactPlan<T>& plan_;
  BoxTree<T> points_, triangles_, edges_;
  std::vector<int> partners_;
};

// A half-space of the scene for one vertex: a plane, or a sphere linearised.
template <class T>
struct Wall {
  Vec3<T> normal;
  T bound;
};

// The list of the last search, with the entries of every vertex.
template <class T>
struct PairList {
  std::vector<ContactPair<T>> pairs;
  std::vector<int> start, entry;  // [vertices + 1]; pair * 4 + corner, in the order of the pairs

  void index(int vertices) {
    start.assign(vertices + 1, 0);
    for (const auto& pair : pairs)
      for (int v : pair.vertex) ++start[v + 1];
    for (int v = 0; v < vertices; ++v) start[v + 1] += start[v];
    entry.resize(pairs.size() * 4);
    place_.assign(start.begin(), start.end() - 1);
    for (int p = 0; p < int(pairs.size()); ++p)
      for (int a = 0; a < 4; ++a) entry[place_[pairs[p].vertex[a]]++] = 4 * p + a;
  }

  // calls visit(pair, corner) for the pairs of a vertex
  template <class Visit>
  void each_of(int vertex, const Visit& visit) const {
    for (int n = start[vertex]; n < start[vertex + 1]; ++n)
      visit(pairs[entry[n] / 4], entry[n] % 4);
  }

  // calls visit(normal, bound, margin) for its half-spaces
  template <class Visit>
  void each_space(int vertex, const Visit& visit) const {
    each_of(vertex, [&](const ContactPair<T>& pair, int corner) {
      visit_space(pair.plane, pair.on_a(corner), visit);
    });
  }

  // calls visit(vertex) for one vertex of each side of all pairs
  template <class Visit>
  void each_side(const Visit& visit) const {
    for (const ContactPair<T>& pair : pairs) {
      visit(pair.vertex[0]);
      visit(pair.vertex[3]);
    }
  }

  // Adds the forces of all pairs to those of the vertices.
  void add_forces(std::vector<Vec3<T>>& force) const {
    for (const ContactPair<T>& pair : pairs) {
      const Vec3<T> each = multiply_add(pair.force.normal, pair.normal, pair.force.tangential);
      for (int a = 0; a < 4; ++a) {
        const int v = pair.vertex[a];
        force[v] = multiply_add(pair.near.weight[a], each, force[v]);
      }
    }
  }

  bool is_stuck(int vertex) const {
    bool stuck = false;
    each_of(vertex, [&](const ContactPair<T>& pair, int) { stuck = stuck || pair.plane.frozen; });
    return stuck;
  }

 private:
  std::vector<int> place_;
};

}  // namespace pd::inline PD_TARGET
