// The pairs of one environment: their search, planes, and what each vertex finds in them.
#pragma once
#include "contact/pairs/pair.h"
#include "cpu/contact/tree.h"
#include "cpu/step/lanes.h"

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace pd::inline PD_TARGET {

// Two sides that may come near. The key is a number of the pair that no search changes.
struct PairSides {
  int vertex[4];
  bool edges;
  std::int64_t key;
};

// Corners of pairs side by side; lanes past the last one repeat it.
template <class T, int W, class PairAt>
PD_HD void gather_corners(const PairAt& pair_at, int count, const std::vector<Vec3<T>>& places,
                          Vec3<Pack<T, W>> (&corner)[4]) {
  T number[12][W];
  for (int lane = 0; lane < W; ++lane) {
    const auto& pair = pair_at(lane < count ? lane : count - 1);
    for (int a = 0; a < 4; ++a) {
      const Vec3<T>& place = places[pair.vertex[a]];
      number[3 * a][lane] = place.x;
      number[3 * a + 1][lane] = place.y;
      number[3 * a + 2][lane] = place.z;
    }
  }
  using P = Pack<T, W>;
  for (int a = 0; a < 4; ++a)
    corner[a] = {P::load(number[3 * a]), P::load(number[3 * a + 1]), P::load(number[3 * a + 2])};
}

// Closest points of pairs of one kind, pair_at(n) for n in [0, count): calls visit(n, closest).
template <class T, class PairAt, class Visit>
void each_closest(bool edges, int count, const PairAt& pair_at, const std::vector<Vec3<T>>& places,
                  const Visit& visit) {
  constexpr int W = native_width<T>;
  for (int begin = 0; begin < count; begin += W) {
    const int some = std::min(W, count - begin);
    Vec3<Pack<T, W>> corner[4];
    gather_corners<T, W>([&](int lane) -> const auto& { return pair_at(begin + lane); }, some,
                         places, corner);
    const Closest<Pack<T, W>> near = closest_points(edges, corner);
    T number[8][W];
    for (int a = 0; a < 4; ++a) near.weight[a].store(number[a]);
    near.diff.x.store(number[4]), near.diff.y.store(number[5]), near.diff.z.store(number[6]);
    near.distance.store(number[7]);
    for (int lane = 0; lane < some; ++lane) {
      visit(begin + lane,
            Closest<T>{{number[0][lane], number[1][lane], number[2][lane], number[3][lane]},
                       {number[4][lane], number[5][lane], number[6][lane]},
                       number[7][lane]});
    }
  }
}

// Finds the sides whose boxes meet.
template <class T>
class PairSearch {
 public:
  explicit PairSearch(const ContactPlan<T>& plan)
      : plan_(plan),
        points_(plan.point_order, plan.points, plan.point, plan.body, plan.bodies),
        triangles_(plan.triangle_order, plan.triangles, plan.triangle, plan.body, plan.bodies),
        edges_(plan.edge_order, plan.edges, plan.edge, plan.body, plan.bodies) {}

  // Boxes of a body. `box_of(vertex)`: of a vertex; `reach(vertex)`: by which boxes of its sides are wider.
  template <class BoxOf, class Reach>
  void refit(int body, const BoxOf& box_of, const Reach& reach) {
    const auto side = [&](const auto& corner) {
      Box<T> box = Box<T>::none();
      T widest(0);
      for (int vertex : corner) {
        box.add(box_of(vertex));
        widest = std::max(widest, T(reach(vertex)));
      }
      return box.widened(widest);
    };
    points_.refit(body, side);
    triangles_.refit(body, side);
    edges_.refit(body, side);
  }

  // Calls visit(sides) for the pairs of two bodies, or of one with itself, whose boxes meet.
  template <class Visit>
  void each_meeting(int body, int beside, const Visit& visit) const {
    const auto with_point = [&](int point, int triangle) {
      const int vertex = plan_.point[point];
      const int* corner = plan_.triangle + 3 * triangle;
      visit(PairSides{{vertex, corner[0], corner[1], corner[2]},
                      false,
                      std::int64_t(vertex) * plan_.triangles + triangle});
    };
    points_.each_meeting(body, triangles_, beside, with_point);
    if (body != beside) points_.each_meeting(beside, triangles_, body, with_point);
    const std::int64_t first_edge = std::int64_t(plan_.vertices) * plan_.triangles;
    edges_.each_meeting(body, edges_, beside, [&](int one, int other) {
      const int first = std::min(one, other), second = std::max(one, other);
      const int *a = plan_.edge + 2 * first, *b = plan_.edge + 2 * second;
      visit(PairSides{
          {a[0], a[1], b[0], b[1]}, true, first_edge + std::int64_t(first) * plan_.edges + second});
    });
  }

  // The thickness of a pair; 0 if it does not count, because a tie joins its sides.
  T thickness_of(const PairSides& pair) const {
    if (plan_.rest_pairs == 0 || plan_.body[pair.vertex[0]] != plan_.body[pair.vertex[3]])
      return plan_.thickness;
    const std::int64_t* const end = plan_.rest_key + plan_.rest_pairs;
    const std::int64_t* const at = std::lower_bound(plan_.rest_key, end, pair.key);
    return at != end && *at == pair.key ? plan_.rest_thickness[at - plan_.rest_key]
                                        : plan_.thickness;
  }

  ContactPair<T> pair_of(const PairSides& sides, T thickness) const {
    const int *v = sides.vertex, first = plan_.body[v[0]], last = plan_.body[v[3]];
    return {{v[0], v[1], v[2], v[3]},
            sides.edges,
            sides.key,
            thickness,
            plan_.friction[std::int64_t(first) * plan_.bodies + last]};
  }

 private:
  const ContactPlan<T>& plan_;
  BoxClusters<T, 1> points_;
  BoxClusters<T, 3> triangles_;
  BoxClusters<T, 2> edges_;
};

// The list of the last search, with the entries of every vertex. Vertices and triangles come first.
template <class T>
struct PairList {
  std::vector<ContactPair<T>> pairs;
  std::vector<int> start, entry;  // [vertices + 1]; pair * 4 + corner, in the order of the pairs
  int points = 0;                 // number of pairs of a vertex and a triangle

  void index(int vertices) {
    start.assign(vertices + 1, 0);
    points = 0;
    for (const auto& pair : pairs) {
      points += pair.edges ? 0 : 1;
      for (int v : pair.vertex) ++start[v + 1];
    }
    for (int v = 0; v < vertices; ++v) start[v + 1] += start[v];
    entry.resize(pairs.size() * 4);
    place_.assign(start.begin(), start.end() - 1);
    for (int p = 0; p < int(pairs.size()); ++p)
      for (int a = 0; a < 4; ++a) entry[place_[pairs[p].vertex[a]]++] = 4 * p + a;
  }

  // calls visit(edges, first pair, number of pairs) for the pairs of each kind
  template <class Visit>
  void each_kind(const Visit& visit) const {
    visit(false, 0, points);
    visit(true, points, int(pairs.size()) - points);
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

  bool is_loaded() const {
    for (const ContactPair<T>& pair : pairs)
      if (pair.force.normal != T(0)) return true;
    return false;
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
