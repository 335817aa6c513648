// The sweeps of an iteration over the pairs that have a force or would come too near; see contact/pairs/multiplier.h.
#pragma once
#include "cpu/contact/pairs.h"

namespace pd::inline PD_TARGET {

// Some of these pairs side by side, for vector instructions.
template <class T>
struct ActiveBlock {
  static constexpr int width = native_width<T>;
  using P = Pack<T, width>;

  T weight[4][width], push[4][width];  // of the corners; theta omega w / D
  T beta[width], thickness[width], friction[width], normal[3][width];
  T between[3][width], before[3][width];  // sums w x of targets, and at the step's start
  T force[4][width];                      // lambda, lambda_t
  int pair[width], local[4][width];  // number of the pair, and of its vertices among those moved
  int count;

  static Vec3<P> load(const T (&of)[3][width]) {
    return {P::load(of[0]), P::load(of[1]), P::load(of[2])};
  }

  Multiplier<T> force_of(int lane) const {
    return {force[0][lane], {force[1][lane], force[2][lane], force[3][lane]}};
  }

  // Adds what the forces shift to the vertices, [vertices, 4] m.
  void shift(std::vector<T>& shifts) const {
    const Vec3<P> sum = multiply_add(P::load(force[0]), load(normal), tangential());
    T number[3][width];
    sum.x.store(number[0]), sum.y.store(number[1]), sum.z.store(number[2]);
    for (int lane = 0; lane < count; ++lane) {
      const Quad<T> each = to_quad(number[0][lane], number[1][lane], number[2][lane]);
      for (int a = 0; a < 4; ++a) {
        T* const of = shifts.data() + 4 * local[a][lane];
        multiply_add(push[a][lane], each, Quad<T>{Pack<T, 4>::load(of)}).q.store(of);
      }
    }
  }

  // The forces after a sweep, by the shifts of the vertices; returns whether one changes.
  bool advance(const std::vector<T>& shifts) {
    T moved[3][width] = {};
    const auto shift_of = [&](int a, int lane) {
      return Quad<T>{Pack<T, 4>::load(shifts.data() + 4 * local[a][lane])};
    };
    for (int lane = 0; lane < count; ++lane) {
      Quad<T> sum = weight[0][lane] * shift_of(0, lane);
      for (int a = 1; a < 4; ++a) sum = multiply_add(weight[a][lane], shift_of(a, lane), sum);
      const Vec3<T> each = to_vec3(sum);
      moved[0][lane] = each.x, moved[1][lane] = each.y, moved[2][lane] = each.z;
    }
    const Multiplier<P> old{P::load(force[0]), tangential()};
    const Multiplier<P> next =
        pd::advance(old, P::load(beta), P::load(thickness), P::load(friction), load(normal),
                    load(between) + load(moved), load(before));
    next.normal.store(force[0]);
    next.tangential.x.store(force[1]), next.tangential.y.store(force[2]);
    next.tangential.z.store(force[3]);
    const auto same = [](const P& a, const P& b) { return a <= b && b <= a; };
    return any(!(same(old.normal, next.normal) && same(old.tangential.x, next.tangential.x) &&
                 same(old.tangential.y, next.tangential.y) &&
                 same(old.tangential.z, next.tangential.z)));
  }

 private:
  Vec3<P> tangential() const { return {P::load(force[1]), P::load(force[2]), P::load(force[3])}; }
};

template <class T>
class ContactSweeps {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit ContactSweeps(const ContactPlan<T>& plan) : local_(plan.vertices, -1) {}

  // Moves the targets and the forces of a list. `begin`: places at the step's start; `inverse`: 1 / D; c = theta omega.
  void run(PairList<T>& list, const Places& begin, const std::vector<T>& inverse, T c,
           Places& target) {
    find_active(list, begin, inverse, c, target);
    if (active_.empty()) return;
    bool changes = true;
    for (int sweep = 0; changes && sweep < contact_sweeps; ++sweep) {
      push();
      changes = false;
      for (ActiveBlock<T>& block : active_) changes |= block.advance(shifts_);
    }
    if (changes) push();
    for (const ActiveBlock<T>& block : active_) {
      for (int lane = 0; lane < block.count; ++lane)
        list.pairs[block.pair[lane]].force = block.force_of(lane);
    }
    for (std::size_t n = 0; n < moved_.size(); ++n) {
      const T* by = shifts_.data() + 4 * n;
      target[moved_[n]] = target[moved_[n]] + Vec3<T>{by[0], by[1], by[2]};
    }
  }

 private:
  // The pairs that have a force or would come too near, as far as their vertices can yield.
  void find_active(PairList<T>& list, const Places& begin, const std::vector<T>& inverse, T c,
                   const Places& target) {
    constexpr int W = native_width<T>;
    using P = Pack<T, W>;
    for (int v : moved_) local_[v] = -1;
    active_.clear(), moved_.clear(), sums_.clear();
    const int count = int(list.pairs.size());
    for (int first = 0; first < count; first += W) {
      const int some = std::min(W, count - first);
      const auto pair_at = [&](int lane) -> const auto& { return list.pairs[first + lane]; };
      Vec3<P> corner[4];
      gather_corners<T, W>(pair_at, some, target, corner);
      T number[9][W];
      for (int lane = 0; lane < W; ++lane) {
        const ContactPair<T>& pair = pair_at(lane < some ? lane : some - 1);
        for (int a = 0; a < 4; ++a) number[a][lane] = pair.near.weight[a];
        number[4][lane] = pair.normal.x, number[5][lane] = pair.normal.y;
        number[6][lane] = pair.normal.z;
        number[7][lane] = pair.thickness, number[8][lane] = pair.force.normal;
      }
      const P weight[4] = {P::load(number[0]), P::load(number[1]), P::load(number[2]),
                           P::load(number[3])};
      const Vec3<P> between = combined(weight, corner);
      const Vec3<P> normal{P::load(number[4]), P::load(number[5]), P::load(number[6])};
      const auto apart =
          P::load(number[7]) <= dot(normal, between) && P::load(number[8]) <= P{T(0)};
      if (!any(!apart)) continue;
      for (int lane = 0; lane < some; ++lane) {
        if (apart.m[lane]) continue;
        ContactPair<T>& pair = list.pairs[first + lane];
        if (pair.can_yield(inverse)) {
          add_active(pair, first + lane, {between.x.v[lane], between.y.v[lane], between.z.v[lane]},
                     begin, inverse, c);
        } else {
          pair.force = {};
        }
      }
    }
    for (ActiveBlock<T>& block : active_) {
      for (int lane = 0; lane < block.count; ++lane) {
        T sum(0);
        for (int a = 0; a < 4; ++a)
          sum = multiply_add(absolute(block.push[a][lane]), sums_[block.local[a][lane]], sum);
        block.beta[lane] = T(1) / sum;
      }
    }
    shifts_.resize(4 * moved_.size());
  }

  void add_active(const ContactPair<T>& pair, int number, const Vec3<T>& between,
                  const Places& begin, const std::vector<T>& inverse, T c) {
    if (active_.empty() || active_.back().count == ActiveBlock<T>::width)
      active_.push_back(ActiveBlock<T>{});
    ActiveBlock<T>& block = active_.back();
    const int lane = block.count++;
    block.pair[lane] = number;
    block.thickness[lane] = pair.thickness, block.friction[lane] = pair.friction;
    const auto put = [&](T(&to)[3][ActiveBlock<T>::width], const Vec3<T>& from) {
      to[0][lane] = from.x, to[1][lane] = from.y, to[2][lane] = from.z;
    };
    Vec3<T> corner[4];
    pair.corners(begin, corner);
    put(block.normal, pair.normal);
    put(block.between, between);
    put(block.before, combined(pair.near.weight, corner));
    block.force[0][lane] = pair.force.normal, block.force[1][lane] = pair.force.tangential.x;
    block.force[2][lane] = pair.force.tangential.y, block.force[3][lane] = pair.force.tangential.z;
    for (int a = 0; a < 4; ++a) {
      const int v = pair.vertex[a];
      if (local_[v] < 0) {
        local_[v] = int(moved_.size());
        moved_.push_back(v);
        sums_.push_back(T(0));
      }
      const T weight = pair.near.weight[a];
      block.local[a][lane] = local_[v];
      block.weight[a][lane] = weight;
      block.push[a][lane] = c * weight * inverse[v];
      sums_[local_[v]] = sums_[local_[v]] + absolute(weight);
    }
  }

  // How the forces of active pairs shift the vertices.
  void push() {
    std::fill(shifts_.begin(), shifts_.end(), T(0));
    for (const ActiveBlock<T>& block : active_) block.shift(shifts_);
  }

  std::vector<ActiveBlock<T>> active_;
  std::vector<int> moved_, local_;  // vertices of active pairs, and their numbers among these
  std::vector<T> sums_;             // of weights
  std::vector<T> shifts_;           // [moved, 4] m, by the forces of active pairs
};

}  // namespace pd::inline PD_TARGET
