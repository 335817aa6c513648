// The sides that may come near each other: which bodies are searched, the balls of the vertices, and the list of pairs.
//
// A body whose parts are far enough apart by its shape alone is not searched for pairs with itself; see RestShapes.
#pragma once
#include "cpu/contact/pairs.h"
#include "cpu/contact/shape.h"

#include <cmath>

namespace pd::inline PD_TARGET {

template <class T>
class NearSearch {
 public:
  using Places = std::vector<Vec3<T>>;

  // `held`: [vertices] whether each moves by hand
  NearSearch(const ContactPlan<T>& plan, const std::vector<char>& held)
      : plan_(plan), held_(held), search_(plan), shapes_(plan), bodies_(plan.bodies) {}

  const RestShapes<T>& shapes() const { return shapes_; }
  const PairSearch<T>& search() const { return search_; }

  // Once it is known what moves by hand.
  void begin() {
    for (int b = 0; b < plan_.bodies; ++b) {
      bodies_[b].is_held = true;
      shapes_.each_of(b, [&](int v) { bodies_[b].is_held = bodies_[b].is_held && held_[v]; });
    }
  }

  // The pairs that may come near while no vertex leaves its ball, and the balls. A ball reaches over what its vertex wants
  // and the thickness. Where that is less than half of the room to the nearest other side, it takes that: no pair more is
  // listed.
  void find(const Places& place, const Places& target, std::vector<Ball<T>>& balls,
            std::vector<ContactPair<T>>& pairs) {
    plan_balls(place, target);
    candidates_[0].clear(), candidates_[1].clear();
    each_meeting([&](int v) { return Box<T>{place[v], place[v]}; },
                 [&](int v) { return bodies_[plan_.body[v]].most + T(0.5) * plan_.thickness; },
                 [&](int b) { return bodies_[b].meets_itself; }, [](int, int) { return true; },
                 [&](const PairSides& sides) { candidates_[sides.edges].push_back(sides); });
    for (bool edges : {false, true}) find_near(edges, place);
    set_balls(place, target, balls);
    pairs.clear();
    for (auto& near : near_) list_near(near, balls, pairs);
  }

  // Calls visit(sides) for pairs of bodies whose boxes meet where between(body, other), and of bodies with themselves where
  // by_itself(body). `box_of(vertex)`, `reach(vertex)`: as for the search.
  template <class BoxOf, class Reach, class ByItself, class Between, class Visit>
  void each_meeting(const BoxOf& box_of, const Reach& reach, const ByItself& by_itself,
                    const Between& between, const Visit& visit) {
    for (int b = 0; b < plan_.bodies; ++b) {
      Body& body = bodies_[b];
      body.box = Box<T>::none();
      body.fitted = false;
      shapes_.each_of(b, [&](int v) { body.box.add(box_of(v).widened(reach(v))); });
    }
    const auto fit = [&](int b) {
      if (!bodies_[b].fitted) search_.refit(b, box_of, reach);
      bodies_[b].fitted = true;
    };
    for (int a = 0; a < plan_.bodies; ++a) {
      for (int b = a; b < plan_.bodies; ++b) {
        const bool meets =
            a == b ? by_itself(a) : between(a, b) && bodies_[a].box.meets(bodies_[b].box);
        if (!meets || (bodies_[a].is_held && bodies_[b].is_held)) continue;
        fit(a), fit(b);
        search_.each_meeting(a, b, [&](const PairSides& sides) {
          const int* v = sides.vertex;
          if (held_[v[0]] && held_[v[1]] && held_[v[2]] && held_[v[3]]) return;
          visit(sides);
        });
      }
    }
  }

 private:
  // A body in a search.
  struct Body {
    Box<T> box;
    T most;                      // radius of its balls
    bool is_held, meets_itself;  // it moves by hand; parts of it may meet
    bool fitted;
  };

  // Sides within reach of the largest balls.
  struct Near {
    PairSides sides;
    T thickness;
    Closest<T> at;
  };

  // What a vertex wants to reach, with a margin.
  T wanted(int v, const Places& place, const Places& target) const {
    const Vec3<T> way = target[v] - place[v];
    return multiply_add(T(ball_reach), square_root(dot(way, way)),
                        held_[v] ? T(0) : plan_.thickness);
  }

  // The largest balls of every body. If they may be so small that its own parts cannot meet, these are not searched.
  void plan_balls(const Places& place, const Places& target) {
    for (int b = 0; b < plan_.bodies; ++b) {
      Body& body = bodies_[b];
      body.most = T(0), body.meets_itself = plan_.touches_itself[b] != 0;
      T most(0);
      shapes_.each_of(b, [&](int v) {
        body.most = T(ball_cells) * plan_.cell[v];
        if (!body.meets_itself) return;
        const T own = wanted(v, place, target);
        most = own > most ? own : most;
      });
      if (!body.meets_itself || body.is_held) continue;
      const T room = T(0.5) * (shapes_.apart(b, place) - T(1.0 + slack_share) * plan_.thickness);
      if (!(room >= std::min(most, body.most))) continue;
      body.meets_itself = false;
      body.most = std::min(body.most, room);
    }
  }

  // Sides of one kind within reach of the largest balls.
  void find_near(bool edges, const Places& place) {
    const std::vector<PairSides>& sides = candidates_[edges];
    near_[edges].clear();
    each_closest<T>(
        edges, int(sides.size()), [&](int n) -> const auto& { return sides[n]; }, place,
        [&](int n, const Closest<T>& at) {
          const int* v = sides[n].vertex;
          const T most = bodies_[plan_.body[v[0]]].most + bodies_[plan_.body[v[3]]].most;
          if (!(at.distance <= most + plan_.thickness)) return;
          const T thickness = search_.thickness_of(sides[n]);
          if (thickness > T(0)) near_[edges].push_back({sides[n], thickness, at});
        });
  }

  void set_balls(const Places& place, const Places& target, std::vector<Ball<T>>& balls) {
    for (int v = 0; v < plan_.vertices; ++v)
      balls[v] = {place[v], T(HUGE_VAL)};  // inside bodies nothing meets
    room_.assign(plan_.vertices, T(HUGE_VAL));
    for (const auto& near : near_) {
      for (const Near& of : near)
        for (int v : of.sides.vertex) room_[v] = std::min(room_[v], of.at.distance);
    }
    for (int n = 0; n < plan_.points; ++n) {
      const int v = plan_.point[n];
      const T roomy = held_[v] ? T(0) : T(ball_room) * (room_[v] - plan_.thickness);
      balls[v].radius =
          std::min(std::max(wanted(v, place, target), roomy), bodies_[plan_.body[v]].most);
    }
  }

  // Lists the pairs within reach of the balls, in the order of their keys.
  void list_near(std::vector<Near>& near, const std::vector<Ball<T>>& balls,
                 std::vector<ContactPair<T>>& pairs) {
    const auto out = std::remove_if(near.begin(), near.end(), [&](const Near& of) {
      const int *v = of.sides.vertex, split = of.sides.edges ? 2 : 1;
      T reach[2] = {T(0), T(0)};
      for (int a = 0; a < 4; ++a) {
        T& side = reach[a < split ? 0 : 1];
        side = std::max(side, balls[v[a]].radius);
      }
      return !(of.at.distance <= reach[0] + reach[1] + plan_.thickness);
    });
    std::sort(near.begin(), out,
              [](const Near& a, const Near& b) { return a.sides.key < b.sides.key; });
    for (auto of = near.begin(); of != out; ++of) {
      pairs.push_back(search_.pair_of(of->sides, of->thickness));
      pairs.back().near = of->at;
    }
  }

  const ContactPlan<T>& plan_;
  const std::vector<char>& held_;
  PairSearch<T> search_;
  RestShapes<T> shapes_;
  std::vector<Body> bodies_;
  std::vector<PairSides> candidates_[2];  // vertices and triangles, edges
  std::vector<Near> near_[2];
  std::vector<T> room_;  // to the nearest other side
};

}  // namespace pd::inline PD_TARGET
