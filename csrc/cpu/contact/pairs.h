// The pairs of one environment: their search, planes, and what each vertex finds in them.
#pragma once
#include "contact/pairs/half_space.h"
#include "contact/pairs/multiplier.h"
#include "contact/pairs/separation.h"
#include "contact/plane_sphere.h"
#include "cpu/contact/tree.h"
#include "cpu/contact/views.h"

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace pd::inline PD_TARGET {

constexpr double floor_share = 0.1;  // least distance of the promise over the thickness

template <class T>
struct ContactPair {
  int vertex[4];
  bool edges;
  std::int64_t key;
  T thickness, friction;
  PairPlane<T> plane = {};
  Multiplier<T> force = {};
  // at the present iterate
  Closest<T> near = {};
  Vec3<T> normal = {};

  T floor() const { return T(floor_share) * thickness; }
  bool on_a(int corner) const { return corner <= (edges ? 1 : 0); }

  void corners(const std::vector<Vec3<T>>& places, Vec3<T> (&out)[4]) const {
    for (int a = 0; a < 4; ++a) out[a] = places[vertex[a]];
  }

  bool has_force() const {
    const Vec3<T>& t = force.tangential;
    return force.normal > T(0) || t.x != T(0) || t.y != T(0) || t.z != T(0);
  }

  // sum w^2 / D
  T yielding(const std::vector<T>& inverse) const {
    T sum(0);
    for (int a = 0; a < 4; ++a)
      sum = multiply_add(near.weight[a] * near.weight[a], inverse[vertex[a]], sum);
    return sum;
  }

  // weight on vertices that move freely
  T freedom(const std::vector<T>& inverse) const {
    T sum(0);
    for (int a = 0; a < 4; ++a)
      if (inverse[vertex[a]] > T(0)) sum = sum + absolute(near.weight[a]);
    return sum;
  }

  Vec3<T> normal_at(const Closest<T>& at) const {
    return at.distance > T(1e-9) ? (T(1) / at.distance) * at.diff : plane.normal;
  }

  // between two places, along the surface
  Vec3<T> slip(const std::vector<Vec3<T>>& places, const std::vector<Vec3<T>>& begin,
               const Closest<T>& at) const {
    Vec3<T> moved[4];
    for (int a = 0; a < 4; ++a) moved[a] = places[vertex[a]] - begin[vertex[a]];
    return tangential(combined(at.weight, moved), normal_at(at));
  }

  // Whether d <= b_A + b_B + r, with b of a side the largest of its vertices.
  template <class Radius>
  bool is_within(const Radius& radius, T thickness) const {
    T reach[2] = {T(0), T(0)};
    for (int a = 0; a < 4; ++a) {
      T& side = reach[on_a(a) ? 0 : 1];
      side = std::max(side, T(radius(vertex[a])));
    }
    return near.distance <= reach[0] + reach[1] + thickness;
  }
};

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
        const int* corner = plan_.triangle + 3 * triangle;
        emit({{vertex, corner[0], corner[1], corner[2]},
              false,
              std::int64_t(vertex) * plan_.triangles + triangle,
              T(0),
              T(0)},
             held, visit);
      });
    }
    const std::int64_t first_edge = std::int64_t(plan_.vertices) * plan_.triangles;
    for (int n = 0; n < plan_.edges; ++n) {
      const int* a = plan_.edge + 2 * n;
      each_partner(edges_, side(a, 2), n, [&](int other) {
        const int* b = plan_.edge + 2 * other;
        emit({{a[0], a[1], b[0], b[1]},
              true,
              first_edge + std::int64_t(n) * plan_.edges + other,
              T(0),
              T(0)},
             held, visit);
      });
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
    const int* v = pair.vertex;
    const int split = pair.edges ? 2 : 1;
    for (int a = 0; a < split; ++a) {
      for (int b = split; b < 4; ++b)
        if (v[a] == v[b]) return;
    }
    const int first = plan_.body[v[0]], last = plan_.body[v[3]];
    if (first == last && !plan_.touches_itself[first]) return;
    if (held(v[0]) && held(v[1]) && held(v[2]) && held(v[3])) return;
    pair.thickness = plan_.thickness;
    if (first == last) {
      const std::int64_t* const end = plan_.rest_key + plan_.rest_pairs;
      const std::int64_t* const at = std::lower_bound(plan_.rest_key, end, pair.key);
      if (at != end && *at == pair.key) pair.thickness = plan_.rest_thickness[at - plan_.rest_key];
      if (!(pair.thickness > T(0))) return;  // a tie joins the sides
    }
    pair.friction = plan_.friction[std::int64_t(first) * plan_.bodies + last];
    visit(pair);
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
      const PairPlane<T>& plane = pair.plane;
      if (pair.on_a(corner)) {
        visit(plane.normal, plane.above, plane.margin);
      } else {
        visit(-plane.normal, -plane.below, plane.margin);
      }
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

// Makes the plane of a pair at `places`, whose vertices want to go to `want`.
template <class T>
void make_plane(ContactPair<T>& pair, const std::vector<Vec3<T>>& places,
                const std::vector<Vec3<T>>& want, const Closest<T>& near, const Vec3<T>& hand) {
  Vec3<T> corner[4], goal[4];
  pair.corners(places, corner);
  pair.corners(want, goal);
  pair.plane =
      divide(pair.edges, corner, goal, pair.floor(), separate(pair.edges, corner, near, hand));
}

}  // namespace pd::inline PD_TARGET
