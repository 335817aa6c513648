// The contact of one environment in one step: every iterate is free of crossings, and so are straight ways between them.
//
// A search lists all pairs that may come near. No vertex leaves its ball, nor the half-spaces of its pairs: see
// contact/pairs/half_space.h. Planes that the next iterate violates are made anew at the present one before.
#pragma once
#include "contact/pairs/shares.h"
#include "cpu/contact/pairs.h"

#include <cmath>

namespace pd::inline PD_TARGET {

template <class T>
class ContactRun {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit ContactRun(const ContactPlan<T>& plan)
      : plan_(plan), search_(plan), held_(plan.vertices), inverse_(plan.vertices) {
    for (Places* places : {&begin_, &place_, &target_, &goal_, &shift_})
      places->resize(plan.vertices);
    is_surface_.assign(plan.vertices, 0);
    for (int n = 0; n < plan.points; ++n) is_surface_[plan.point[n]] = 1;
    for (int v = plan.body_vertices; v < plan.vertices; ++v) {
      if (hands_.size() <= std::size_t(plan.collider[v])) hands_.push_back({{}, {}, v, v});
      hands_.back().end = v + 1;
    }
    balls_.resize(plan.vertices);
  }

  const ContactPlan<T>& plan() const { return plan_; }
  Places& place() { return place_; }              // of the present iterate
  Places& target() { return target_; }            // of the next one, before contact
  Places& goal() { return goal_; }                // of what moves by hand
  std::vector<T>& inverse() { return inverse_; }  // 1 / D; 0 for what moves by hand
  const Places& begin_places() const { return begin_; }  // at the step's start
  const PairList<T>& list() const { return list_; }
  bool moves_by_hand(int vertex) const { return held_[vertex] != 0; }
  bool was_cut(int vertex) const { return cut_[vertex] != 0; }
  bool is_at_rest() const { return !cut_any_ && !waits_; }

  double gap = HUGE_VAL;
  std::int64_t most_pairs = 0, searches = 0, shortened = 0, frozen = 0;
  bool overflows() const { return most_pairs > plan_.capacity; }

  // A step begins at the places of bodies; poses are those of colliders, actual ones and those of the step's end.
  void begin(const T* actual, const T* wanted, const std::int64_t* keys, const T* forces) {
    for (std::size_t c = 0; c < hands_.size(); ++c) {
      Hand<T>& hand = hands_[c];
      hand.pose = Hand<T>::read(actual + 7 * c);
      hand.goal = Hand<T>::read(wanted + 7 * c);
      for (int v = hand.begin; v < hand.end; ++v) {
        place_[v] = hand.pose.place(local_point(plan_, v));
        goal_[v] = hand.goal.place(local_point(plan_, v));
      }
    }
    for (int v = 0; v < plan_.vertices; ++v) held_[v] = !(inverse_[v] > T(0));
    begin_ = place_;
    known_.clear();
    for (int n = 0; n < plan_.capacity && keys[n] >= 0; ++n) {
      const T* f = forces + 4 * n;
      known_.push_back({keys[n], {f[0], {f[1], f[2], f[3]}}});
    }
    gap = HUGE_VAL;
    most_pairs = searches = shortened = frozen = 0;
    searched_at_ = 0;
    waits_ = checked_ = false;
  }

  // Lists the pairs that may come near while no vertex leaves its ball. A ball reaches over what its vertex wants and the
  // thickness. Where that is less than half of the room to the nearest other side, it takes that: no pair more is listed.
  void find() {
    const auto most = [&](int v) { return T(ball_cells) * plan_.cell[v]; };
    near_.clear();
    room_.assign(plan_.vertices, T(HUGE_VAL));
    search_.each_boxed([&](int v) { return Box<T>{place_[v], place_[v]}; },
                       [&](int v) { return most(v) + T(0.5) * plan_.thickness; },
                       [&](int v) { return moves_by_hand(v); },
                       [&](ContactPair<T>& pair) {
                         Vec3<T> corner[4];
                         pair.corners(place_, corner);
                         pair.near = closest_points(pair.edges, corner);
                         if (!pair.is_within(most, plan_.thickness)) return;
                         for (int v : pair.vertex)
                           room_[v] = std::min(room_[v], pair.near.distance);
                         near_.push_back(pair);
                       });
    for (int v = 0; v < plan_.vertices; ++v) {
      const Vec3<T> way = target_[v] - place_[v];
      const T wanted =
          T(ball_reach) * square_root(dot(way, way)) + (held_[v] ? T(0) : plan_.thickness);
      const T roomy = held_[v] ? T(0) : T(ball_room) * (room_[v] - plan_.thickness);
      radius(v) = std::min(std::max(wanted, roomy), most(v));
      balls_[v].center = place_[v];
    }
    list_.pairs.clear();
    for (ContactPair<T>& pair : near_) {
      if (!pair.is_within([&](int v) { return balls_[v].radius; }, plan_.thickness)) continue;
      make_plane(pair, place_, target_, pair.near, Vec3<T>{});
      list_.pairs.push_back(pair);
    }
    // inside bodies nothing meets
    for (int v = 0; v < plan_.vertices; ++v)
      if (!is_surface_[v]) radius(v) = T(HUGE_VAL);
    most_pairs = std::max(most_pairs, std::int64_t(list_.pairs.size()));
    ++searches;
    if (overflows()) list_.pairs.clear();
    list_.index(plan_.vertices);
    look();
    for (ContactPair<T>& pair : list_.pairs) {
      const auto at =
          std::lower_bound(known_.begin(), known_.end(), pair.key,
                           [](const Known& a, std::int64_t key) { return a.key < key; });
      if (at == known_.end() || at->key != pair.key) continue;
      pair.force = {at->force.normal, tangential(at->force.tangential, pair.normal)};
    }
  }

  // Closest points and normals of all pairs at the present iterate.
  void look() {
    for (ContactPair<T>& pair : list_.pairs) {
      Vec3<T> corner[4];
      pair.corners(place_, corner);
      pair.near = closest_points(pair.edges, corner);
      pair.normal = pair.normal_at(pair.near);
    }
  }

  // E + psi at the last check and now, both by the list and the multipliers of now.
  struct Merits {
    double before, now;
    bool known;
  };
  Merits check(double energy) {
    Merits merits{checked_energy_, energy, checked_};
    for (const ContactPair<T>& pair : list_.pairs) {
      const T yielding = pair.yielding(inverse_);
      const auto psi = [&](const Places& places, const Closest<T>& at) {
        return augmented_lagrangian(pair.force, yielding, pair.thickness, pair.friction,
                                    at.distance, pair.slip(places, begin_, at));
      };
      if (checked_) {
        Vec3<T> corner[4];
        pair.corners(checked_place_, corner);
        merits.before += psi(checked_place_, closest_points(pair.edges, corner));
      }
      merits.now += psi(place_, pair.near);
    }
    checked_energy_ = energy;
    checked_place_ = place_;
    checked_ = true;
    return merits;
  }

  // After a coarse correction: forces of a pair; the last check says nothing more.
  void set_force(int pair, const Multiplier<T>& force) { list_.pairs[pair].force = force; }
  void forget_check() { checked_ = false; }

  bool leaves_ball(int v, Vec3<T> place) const { return move_into(balls_[v], place); }

  // Planes that `to` violates are made anew at the present iterate.
  void refresh(const Places& to) {
    for (ContactPair<T>& pair : list_.pairs) {
      if (breaks(pair, to)) make_plane(pair, place_, to, pair.near, pair.plane.normal);
    }
  }

  // The proximal step: multipliers in the metric of D, and what they move. c = theta omega.
  void prox(T c) {
    active_.clear();
    for (int p = 0; p < int(list_.pairs.size()); ++p) {
      ContactPair<T>& pair = list_.pairs[p];
      if (!(pair.freedom(inverse_) > T(least_yield))) {
        pair.force = {};  // nothing can yield
        continue;
      }
      Vec3<T> corner[4];
      pair.corners(target_, corner);
      const bool touches = dot(pair.normal, combined(pair.near.weight, corner)) < pair.thickness;
      if (touches || pair.force.normal > T(0)) active_.push_back(p);
    }
    if (active_.empty()) return;
    weights_.assign(plan_.vertices, T(0));
    for (int p : active_) {
      const ContactPair<T>& pair = list_.pairs[p];
      for (int a = 0; a < 4; ++a)
        weights_[pair.vertex[a]] = weights_[pair.vertex[a]] + absolute(pair.near.weight[a]);
    }
    for (int sweep = 0; sweep < contact_sweeps; ++sweep) {
      push(c);
      for (int p : active_) {
        ContactPair<T>& pair = list_.pairs[p];
        const T sum = row_bound(pair, weights_, inverse_);
        Vec3<T> between[4], before[4];
        pair.corners(shift_, between);
        pair.corners(begin_, before);
        pair.force =
            advance(pair.force, T(1) / (c * sum), pair.thickness, pair.friction, pair.normal,
                    combined(pair.near.weight, between), combined(pair.near.weight, before));
      }
    }
    push(c);
    for (int p : active_)
      for (int v : list_.pairs[p].vertex) target_[v] = shift_[v];
  }

  // Goes as near to the targets as the promise allows. `walls(vertex, visit)`: half-spaces of the scene.
  template <class Walls>
  void move(const Walls& walls) {
    cut_.assign(plan_.vertices, 0);
    cut_any_ = false;
    shift_ = place_;
    for (int v = 0; v < plan_.vertices; ++v) {
      if (held_[v]) continue;
      if (list_.is_stuck(v)) {
        cut(v);
        ++frozen;
        continue;
      }
      const LimitedPlace<T> to = limit(target_[v], place_[v], balls_[v],
                                       [&](const auto& visit) { each_space(v, walls, visit); });
      shift_[v] = to.place;
      if (to.shortened) cut(v);
    }
    move_hands(walls);
    std::swap(place_, shift_);
  }

  // Before the move of iteration k: a search if a vertex wants to leave its ball, else planes that targets violate are made
  // anew at the present iterate. Searches pause while pairs have forces.
  void prepare(int k) {
    remember();
    bool outside = false, loaded = false;
    for (int v = 0; v < plan_.vertices && !outside; ++v) {
      Vec3<T> target = target_[v];
      outside = move_into(balls_[v], target);
    }
    for (const ContactPair<T>& pair : list_.pairs) loaded = loaded || pair.force.normal != T(0);
    const bool due = k - searched_at_ >= search_pause || !loaded;
    waits_ = outside && !due;
    if (!outside || !due) return refresh(target_);
    searched_at_ = k;
    find();
  }

  // Forces of all pairs are known to the next search.
  void remember() {
    known_.clear();
    for (const ContactPair<T>& pair : list_.pairs)
      if (pair.has_force()) known_.push_back({pair.key, pair.force});
  }

  // calls visit(key, force), in the order of the keys
  template <class Visit>
  void each_force(const Visit& visit) const {
    for (const Known& known : known_) visit(known.key, known.force);
  }

  // calls visit(vertex) for vertices of pairs between bodies with a force that is known, one of each side
  template <class Visit>
  void each_known(const Visit& visit) const {
    const std::int64_t first_edge = first_edge_key(plan_);
    for (const Known& known : known_) {
      const bool edges = known.key >= first_edge;
      const std::int64_t key = edges ? known.key - first_edge : known.key,
                         count = edges ? plan_.edges : plan_.triangles;
      const int a = edges ? plan_.edge[2 * (key / count)] : int(key / count),
                b = edges ? plan_.edge[2 * (key % count)] : plan_.triangle[3 * (key % count)];
      if (plan_.body[a] == plan_.body[b]) continue;
      visit(a);
      visit(b);
    }
  }

  // At the step's end: least d / r.
  void measure() {
    look();
    gap = HUGE_VAL;
    for (const ContactPair<T>& pair : list_.pairs) {
      const double share = double(pair.near.distance / pair.thickness);
      gap = share < gap ? share : gap;
    }
  }

  double held_back(int begin, int end) const {
    double most = 0;
    for (int v = begin; v < end; ++v) {
      if (!held_[v]) continue;
      const Vec3<T> left = place_[v] - goal_[v];
      const double length = double(square_root(dot(left, left)));
      most = length > most ? length : most;
    }
    return most;
  }

  PairSearch<T>& search() { return search_; }
  std::vector<Hand<T>>& hands() { return hands_; }

 private:
  struct Known {
    std::int64_t key;
    Multiplier<T> force;
  };

  T& radius(int v) { return balls_[v].radius; }

  // targets, shifted by the forces of active pairs
  void push(T c) {
    for (int p : active_)
      for (int v : list_.pairs[p].vertex) shift_[v] = target_[v];
    for (int p : active_) {
      const ContactPair<T>& pair = list_.pairs[p];
      const Vec3<T> force = multiply_add(pair.force.normal, pair.normal, pair.force.tangential);
      for (int a = 0; a < 4; ++a) {
        const int v = pair.vertex[a];
        shift_[v] = multiply_add(c * pair.near.weight[a] * inverse_[v], force, shift_[v]);
      }
    }
  }

  template <class Walls, class Visit>
  void each_space(int v, const Walls& walls, const Visit& visit) const {
    list_.each_space(v, visit);
    const T here = place_rounding(place_[v]), there = place_rounding(target_[v]),
            margin = here < there ? there : here;
    walls(v, place_[v], [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
  }

  void cut(int v) {
    cut_[v] = 1;
    cut_any_ = true;
    ++shortened;
  }

  template <class Walls>
  void move_hands(const Walls& walls) {
    const auto allowed = [&](int v, const Vec3<T>& to) {
      return is_allowed(to, balls_[v], [&](const auto& visit) { each_space(v, walls, visit); });
    };
    for (int v = 0; v < plan_.body_vertices; ++v) {
      if (!held_[v]) continue;
      const Vec3<T> way = goal_[v] - place_[v];
      const auto at = [&](T share) {
        return share < T(1) ? multiply_add(share, way, place_[v]) : goal_[v];
      };
      const T share =
          list_.is_stuck(v) ? T(0) : largest_share<T>([&](T s) { return allowed(v, at(s)); });
      shift_[v] = share > T(0) ? at(share) : place_[v];
      if (share < T(1)) cut(v);
    }
    for (Hand<T>& hand : hands_) {
      bool stuck = false;
      for (int v = hand.begin; v < hand.end; ++v) stuck = stuck || list_.is_stuck(v);
      const Screw<T> screw(hand.pose, hand.goal);
      const T share = stuck ? T(0) : largest_share<T>([&](T s) {
        const Pose<T> pose = screw.at(s);
        for (int v = hand.begin; v < hand.end; ++v)
          if (!allowed(v, pose.place(local_point(plan_, v)))) return false;
        return true;
      });
      hand.pose = screw.at(share);
      for (int v = hand.begin; v < hand.end; ++v) {
        shift_[v] = hand.pose.place(local_point(plan_, v));
        if (share < T(1)) cut(v);
      }
    }
  }

  const ContactPlan<T>& plan_;
  PairSearch<T> search_;
  PairList<T> list_;
  std::vector<Hand<T>> hands_;
  std::vector<char> held_, is_surface_, cut_;
  std::vector<T> inverse_, weights_;
  Places begin_, place_, target_, goal_, shift_;
  std::vector<Ball<T>> balls_;
  std::vector<Known> known_;
  std::vector<int> active_;
  std::vector<ContactPair<T>> near_;  // of a search, before balls are known
  std::vector<T> room_;               // to the nearest other side
  Places checked_place_;
  double checked_energy_ = 0;
  bool checked_ = false, cut_any_ = false, waits_ = false;
  int searched_at_ = 0;
};

}  // namespace pd::inline PD_TARGET
