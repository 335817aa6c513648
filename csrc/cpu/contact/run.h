// The contact of one environment in one step: every iterate is free of crossings, and so are straight ways between them.
//
// A search lists all pairs that may come near. No vertex leaves its ball, nor the half-spaces of its pairs: see
// contact/pairs/half_space.h. Planes that the next iterate violates are made anew at the present one before.
#pragma once
#include "contact/pairs/shares.h"
#include "cpu/contact/active.h"
#include "cpu/contact/near.h"

#include <cmath>

namespace pd::inline PD_TARGET {

template <class T>
class ContactRun {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit ContactRun(const ContactPlan<T>& plan)
      : plan_(plan),
        held_(plan.vertices),
        near_(plan, held_),
        sweeps_(plan),
        inverse_(plan.vertices) {
    for (Places* places : {&begin_, &place_, &target_, &goal_, &shift_})
      places->resize(plan.vertices);
    for (int v = plan.body_vertices; v < plan.vertices; ++v) {
      if (hands_.size() <= std::size_t(plan.collider[v])) hands_.push_back({{}, {}, v, v});
      hands_.back().end = v + 1;
    }
    balls_.resize(plan.vertices);
    limits_.resize(plan.vertices, Limits::none);
  }

  const ContactPlan<T>& plan() const { return plan_; }
  Places& place() { return place_; }                     // of the present iterate
  Places& target() { return target_; }                   // of the next one, before contact
  Places& goal() { return goal_; }                       // of what moves by hand
  std::vector<T>& inverse() { return inverse_; }         // 1 / D; 0 for what moves by hand
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
    near_.begin();
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

  // Lists the pairs that may come near, with planes, and the forces that are known of them.
  void find() {
    near_.find(place_, target_, balls_, list_.pairs);
    most_pairs = std::max(most_pairs, std::int64_t(list_.pairs.size()));
    ++searches;
    if (overflows()) list_.pairs.clear();
    list_.index(plan_.vertices);
    std::fill(limits_.begin(), limits_.end(), Limits::none);
    for (ContactPair<T>& pair : list_.pairs) renew_plane(pair, target_, Vec3<T>{});
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
    list_.each_kind([&](bool edges, int first, int count) {
      each_closest<T>(
          edges, count, [&](int n) -> const auto& { return list_.pairs[first + n]; }, place_,
          [&](int n, const Closest<T>& near) {
            ContactPair<T>& pair = list_.pairs[first + n];
            pair.near = near;
            pair.normal = pair.normal_at(near);
          });
    });
  }

  // E + psi at the last check and now, both by the list and the multipliers of now.
  struct Merits {
    double before, now;
    bool known;
  };
  Merits check(double energy) {
    Merits merits{checked_energy_, energy, checked_};
    const auto add = [&](double& sum, const ContactPair<T>& pair, const Places& places,
                         const Closest<T>& at) {
      if (!(pair.force.normal > T(0)) && !(at.distance < pair.thickness)) return;  // psi is 0
      sum += augmented_lagrangian(pair.force, pair.yielding(inverse_), pair.thickness,
                                  pair.friction, at.distance, pair.slip(places, begin_, at));
    };
    for (const ContactPair<T>& pair : list_.pairs) add(merits.now, pair, place_, pair.near);
    if (checked_) {
      list_.each_kind([&](bool edges, int first, int count) {
        const auto pair_at = [&](int n) -> const auto& { return list_.pairs[first + n]; };
        each_closest<T>(edges, count, pair_at, checked_place_, [&](int n, const Closest<T>& near) {
          add(merits.before, pair_at(n), checked_place_, near);
        });
      });
    }
    checked_energy_ = energy;
    checked_place_ = place_;
    checked_ = true;
    return merits;
  }

  // After a coarse correction: forces of a pair; the last check says nothing more.
  void set_force(int pair, const Multiplier<T>& force) { list_.pairs[pair].force = force; }
  void forget_check() { checked_ = false; }

  bool leaves_ball(int v, const Vec3<T>& place) const { return !is_inside(v, place); }

  // Planes that `to` violates are made anew at the present iterate.
  void refresh(const Places& to) {
    std::fill(limits_.begin(), limits_.end(), Limits::none);
    list_.each_kind([&](bool edges, int first, int count) {
      constexpr int W = native_width<T>;
      using P = Pack<T, W>;
      for (int begin = 0; begin < count; begin += W) {
        const int some = std::min(W, count - begin);
        const auto pair_at = [&](int lane) -> const auto& {
          return list_.pairs[first + begin + lane];
        };
        Vec3<P> corner[4];
        gather_corners<T, W>(pair_at, some, to, corner);
        T number[5][W];
        bool frozen = false;
        for (int lane = 0; lane < W; ++lane) {
          const PairPlane<T>& plane = pair_at(lane < some ? lane : some - 1).plane;
          number[0][lane] = plane.normal.x, number[1][lane] = plane.normal.y;
          number[2][lane] = plane.normal.z;
          number[3][lane] = plane.above, number[4][lane] = plane.below;
          frozen = frozen || plane.frozen;
        }
        const Vec3<P> normal{P::load(number[0]), P::load(number[1]), P::load(number[2])};
        const P above = P::load(number[3]), below = P::load(number[4]);
        P least{T(HUGE_VAL)};  // of the slacks
        for (int a = 0; a < 4; ++a) {
          const P height = dot(normal, corner[a]);
          least = lesser(least, a <= (edges ? 1 : 0) ? height - above : below - height);
        }
        const auto broken = least < P{T(0)};
        if (!frozen && !any(broken)) continue;
        for (int lane = 0; lane < some; ++lane) {
          ContactPair<T>& pair = list_.pairs[first + begin + lane];
          if (broken.m[lane] || pair.plane.frozen) renew_plane(pair, to, pair.plane.normal);
        }
      }
    });
  }

  // The proximal step: multipliers in the metric of D, and what they move. c = theta omega.
  void prox(T c) { sweeps_.run(list_, begin_, inverse_, c, target_); }

  // Goes as near to the targets as the promise allows. `walls(vertex, visit)`: half-spaces of the scene. Only planes that
  // are new since the last move may cut a way: `refresh` has compared the targets with the others.
  template <class Walls>
  void move(const Walls& walls) {
    cut_.assign(plan_.vertices, 0);
    cut_any_ = false;
    for (int v = 0; v < plan_.vertices; ++v) {
      if (held_[v]) {
        shift_[v] = place_[v];
        continue;
      }
      if (limits_[v] == Limits::stuck) {
        shift_[v] = place_[v];
        cut(v);
        ++frozen;
        continue;
      }
      bool is_free = limits_[v] == Limits::none && is_inside(v, target_[v]);
      each_wall(v, walls, [&](const Vec3<T>& normal, T bound, T) {
        is_free = is_free && !(dot(normal, target_[v]) - bound < T(0));
      });
      if (is_free) {
        shift_[v] = target_[v];
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
    bool outside = false;
    for (int v = 0; v < plan_.vertices && !outside; ++v) outside = !is_inside(v, target_[v]);
    const bool due = outside && (k - searched_at_ >= search_pause || !list_.is_loaded());
    waits_ = outside && !due;
    if (!due) return refresh(target_);
    searched_at_ = k;
    remember();
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
    const std::int64_t first_edge = std::int64_t(plan_.vertices) * plan_.triangles;
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

  NearSearch<T>& near() { return near_; }
  std::vector<Hand<T>>& hands() { return hands_; }

 private:
  struct Known {
    std::int64_t key;
    Multiplier<T> force;
  };

  bool is_inside(int v, const Vec3<T>& place) const {
    const Ball<T>& ball = balls_[v];
    const Vec3<T> arm = place - ball.center;
    if (dot(arm, arm) <= ball.radius * ball.radius) return true;
    Vec3<T> copy = place;
    return !move_into(ball, copy);
  }

  // Whether planes of its pairs may cut the way of a vertex, or whether it must stay.
  enum class Limits : char { none, planes, stuck };

  void renew_plane(ContactPair<T>& pair, const Places& to, const Vec3<T>& hand) {
    make_plane(pair, place_, to, pair.near, hand);
    for (int v : pair.vertex) {
      if (pair.plane.frozen) limits_[v] = Limits::stuck;
      if (limits_[v] == Limits::none) limits_[v] = Limits::planes;
    }
  }

  template <class Walls, class Visit>
  void each_wall(int v, const Walls& walls, const Visit& visit) const {
    const T here = place_rounding(place_[v]), there = place_rounding(target_[v]),
            margin = here < there ? there : here;
    walls(v, place_[v], [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
  }

  template <class Walls, class Visit>
  void each_space(int v, const Walls& walls, const Visit& visit) const {
    list_.each_space(v, visit);
    each_wall(v, walls, visit);
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
      if (way.x == T(0) && way.y == T(0) && way.z == T(0)) continue;
      const auto at = [&](T share) {
        return share < T(1) ? multiply_add(share, way, place_[v]) : goal_[v];
      };
      const T share = limits_[v] == Limits::stuck
                          ? T(0)
                          : largest_share<T>([&](T s) { return allowed(v, at(s)); });
      shift_[v] = share > T(0) ? at(share) : place_[v];
      if (share < T(1)) cut(v);
    }
    for (Hand<T>& hand : hands_) {
      if (hand.is_there()) continue;
      bool stuck = false;
      for (int v = hand.begin; v < hand.end; ++v) stuck = stuck || limits_[v] == Limits::stuck;
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
  std::vector<char> held_, cut_;
  NearSearch<T> near_;
  ContactSweeps<T> sweeps_;
  PairList<T> list_;
  std::vector<Hand<T>> hands_;
  std::vector<T> inverse_;
  Places begin_, place_, target_, goal_, shift_;
  std::vector<Ball<T>> balls_;
  std::vector<Limits> limits_;
  std::vector<Known> known_;
  Places checked_place_;
  double checked_energy_ = 0;
  bool checked_ = false, cut_any_ = false, waits_ = false;
  int searched_at_ = 0;
};

}  // namespace pd::inline PD_TARGET
