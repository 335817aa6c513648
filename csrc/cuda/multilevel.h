// Runner of solver/multilevel.h on a GPU: all iterations of one environment by a team of blocks, see also
// cpu/multilevel_stepper.h. What goes before and after them is a launch each, as in stream.h.
#pragma once
#include "cuda/cycle.h"
#include "cuda/stream.h"

namespace pd::inline PD_TARGET {

constexpr int outer_dots = 2 * history + 3;  // sums that one pass over the vertices may make
constexpr int ranges_count = 2;              // that a round of Ranges compares
constexpr int most_chunks = 640;             // of vertices, each added up by one warp

// Device memory of the teams.
template <class T>
struct OuterMemory {
  Quad<T>*base, *pull, *fresh, *direction;  // [teams, vertices]
  Quad<T>*s, *y;                            // [teams, history, vertices], with pairs
  Mat3<T>*free, *fresh_free;                // [teams, vertices], with contacts
  Quad<T>*gradient, *fresh_gradient;        // [teams, vertices], with contacts
  CycleMemory<T> cycle;                     // [teams, ...]
  double* chunk_dots;                       // [teams, 2, chunks, outer_dots], passes alternate
  double* row_sums;                         // [teams, rows, sums_count]
  Range* ranges;                            // [teams, 2, blocks, ranges_count], rounds alternate
  Misfit* misfit;                           // [batch]
  unsigned* counter;                        // [teams], zero at the launch
};

template <class T>
struct OuterCall {
  StreamCall<T> stream;
  OuterMemory<T> memory;
  int teams, blocks;  // blocks of a team

  PD_HD const DevicePlan<T>& plan() const { return stream.step.plan; }
  // vertices of a chunk: whole warps, few enough chunks that every block can add them up
  PD_HD int chunk() const {
    return (plan().vertices + most_chunks * warp_size - 1) / (most_chunks * warp_size) * warp_size;
  }
  PD_HD int chunks() const { return (plan().vertices + chunk() - 1) / chunk(); }
  PD_HD int shared_rows() const { return (plan().shared + pass_threads - 1) / pass_threads; }
  PD_HD int rows() const { return plan().patches + shared_rows(); }
};

// In shared memory: what all threads of a block go by; its first thread decides.
template <class T>
struct OuterControl {
  Outer outer;
  Pairs pairs;
  double total[outer_dots];
  double factor[history];
  bool accepted, finite, done;
  StripSums<T> strip;
};

// The arrays of one team.
template <class T>
PD_DEVICE OuterMemory<T> of_team(const OuterCall<T>& call, int team) {
  OuterMemory<T> m = call.memory;
  const std::int64_t n = call.plan().vertices, at = team * n;
  for (Quad<T>** array : {&m.base, &m.pull, &m.fresh, &m.direction, &m.gradient, &m.fresh_gradient})
    *array += at;
  m.s += history * at;
  m.y += history * at;
  m.free += at;
  m.fresh_free += at;
  m.cycle = cycle_of_team(call.plan().levels, m.cycle, team);
  m.chunk_dots += std::int64_t(team) * 2 * call.chunks() * outer_dots;
  m.row_sums += std::int64_t(team) * call.rows() * sums_count;
  m.ranges += std::int64_t(team) * 2 * call.blocks * ranges_count;
  return m;
}

template <class T, bool Touching>
class MultilevelRunner {
 public:
  PD_DEVICE MultilevelRunner(const OuterCall<T>& call, const OuterMemory<T>& memory,
                             std::int64_t environment, BlockTeam& team, OuterControl<T>& control,
                             std::byte* shared)
      : call_(call),
        w_(call.stream, environment),
        m_(memory),
        team_(team),
        c_(control),
        cycle_(call.plan().levels, memory.cycle, team, control.strip),
        shared_(shared),
        lbfgs_(call.stream.step.settings.schedule == ScheduleKind::lbfgs) {
    const Misfit& misfit = m_.misfit[environment];
    strangers_ = misfit.strangers;
    trusted_ = T(misfit.trusted);
    if (threadIdx.x == 0) {
      c_.outer = {};
      c_.outer.scale = misfit.scale;
      c_.outer.friction = w_.contacts.friction() > T(0);
      c_.outer.slack = c_.outer.friction ? guard_slack_friction : energy_noise<T>();
      c_.pairs = {};
      c_.done = false;
    }
    if (is_first()) {
      w_.progress.schedule.rho = misfit.spread;
      w_.progress.used = 0;
    }
    __syncthreads();
  }

  PD_DEVICE bool finished() const { return c_.done; }

  // E and what is out of balance at the trial u
  PD_DEVICE void evaluate(int) {
    for (int patch = team_.rank(); patch < w_.plan.patches; patch += team_.blocks()) {
      ThreadSums sums = {{0, 0, 0}};
      sums.value[0] +=
          pass_over_patch(w_, patch, shared_, SolidGradient<true>{},
                          [&](int i, const Vec3<T>& force) { look_at(i, force, sums); });
      write_sums<Visit::measure>(sums, row(patch));
    }
    team_.barrier();
    for (int chunk = team_.rank(); chunk < call_.shared_rows(); chunk += team_.blocks()) {
      ThreadSums sums = {{0, 0, 0}};
      const int i = chunk * pass_threads + int(threadIdx.x);
      if (i < w_.plan.shared)
        look_at(w_.plan.patch_vertex[w_.plan.patches] + i, shared_force(w_, i), sums);
      __syncthreads();  // the block's sums of before have been read
      write_sums<Visit::measure>(sums, row(w_.plan.patches + chunk));
    }
    team_.barrier();
  }

  // every block decides from the same sums, so all decide alike
  PD_DEVICE void judge(int) {
    ThreadSums sums = {{0, 0, 0}};
    for (int r = threadIdx.x; r < call_.rows(); r += blockDim.x) {
      for (int n = 0; n < 2; ++n) sums.value[n] += row(r)[n];
    }
    write_sums<Visit::measure>(sums, c_.total);
    if (threadIdx.x == 0) {
      const double work = c_.outer.known ? c_.total[1] : 0, energy = c_.total[0] + work;
      c_.accepted = c_.outer.accept(energy, lbfgs_);
      // the friction of another base does other work
      if (c_.accepted) c_.outer.energy -= work;
      c_.finite = energy < HUGE_VAL;
    }
    __syncthreads();
  }

  // The pair from the base to the trial, kept or not: it holds for the curvature on the way. Then the base moves on.
  PD_DEVICE void learn(int k) {
    newest_ = (newest_ + 1) % history;
    pass<outer_dots>([&](int i, double (&sum)[outer_dots]) {
      const Vec3<T> u = vec3(w_.v.u[i]), fresh = vec3(m_.fresh[i]);
      const Vec3<T> base = k == 0 ? u : vec3(m_.base[i]), pull = k == 0 ? fresh : vec3(m_.pull[i]);
      const Vec3<T> change = u - base;
      Vec3<T> s = let_through(i, change, k), y = let_through(i, fresh - pull, k);
      if constexpr (Touching) keep_directions(i, k);
      const bool accepted = c_.accepted;
      // what momentum goes on along
      if (accepted || k == 0) w_.v.set_before(i, base);
      const Vec3<T> left = accepted ? fresh : pull;
      m_.base[i] = quad(accepted ? u : base);
      m_.pull[i] = quad(left);
      sum[2 * history] += double(dot(change, change));
      sum[2 * history + 1] += double(dot(u, u));
      if (!lbfgs_) return;
      // a trial out of range must not poison sums in which it has no part
      if (!c_.finite) s = y = none();
      m_.s[newest_ * vertices() + i] = quad(s);
      m_.y[newest_ * vertices() + i] = quad(y);
      const Vec3<T> g = let_through(i, left);
#pragma unroll
      for (int j = 0; j < history; ++j) {
        if (j != newest_ && !c_.pairs.valid[j]) continue;
        const Vec3<T> way = j == newest_ ? s : vec3(m_.s[j * vertices() + i]);
        sum[j] += double(dot(way, y));
        sum[history + j] += double(dot(way, g));
      }
      sum[2 * history + 2] += double(dot(y, y));
    });
    if (threadIdx.x == 0) {
      stop(k, c_.total[2 * history], c_.total[2 * history + 1]);
      if (lbfgs_) remember(k);
    }
    __syncthreads();
  }

  // direction = theta M g, corrected by the pairs; contacts and what M does not know go by the diagonal
  PD_DEVICE void precondition() {
    const T scale = T(w_.settings().relaxation / c_.outer.scale);
    each_vertex([&](int i) {
      Vec3<T> q = let_through(i, vec3(m_.pull[i]));
      if (lbfgs_) {
#pragma unroll
        for (int j = 0; j < history; ++j) {
          if (c_.pairs.valid[j])
            q = subtract_product(q, T(c_.pairs.alpha[j]), vec3(m_.y[j * vertices() + i]));
        }
        q = let_through(i, q);
      }
      cycle_.set(i, scale * q);
    });
    cycle_.run();
    if (lbfgs_) return correct();
    each_vertex([&](int i) { m_.direction[i] = quad(cycle_.result(i)); });
  }

  // next trial: P(u + beta (u - before) - (1 + beta) t d), or a plain or accelerated Jacobi iteration
  PD_DEVICE void advance() {
    const bool plain = c_.outer.plain, accelerates = c_.outer.diagonal && !plain;
    const bool extrapolates = accelerates || (!lbfgs_ && !plain);
    const double limit = accelerates ? w_.progress.schedule.limit : Outer::momentum_limit();
    __syncthreads();
    if (threadIdx.x == 0) c_.total[0] = extrapolates ? c_.outer.extrapolation(limit) : 0;
    if (is_first()) ++w_.progress.used;
    __syncthreads();
    const T beta = T(c_.total[0]), length = T((1 + c_.total[0]) * c_.outer.length());
    const T theta = T(w_.settings().relaxation);
    each_vertex([&](int i) {
      const auto v = w_.v.at(i);
      const Vec3<T> u = vec3(m_.base[i]), before = vec3(w_.v.before[i]);
      Vec3<T> next = u - way(i, length * vec3(m_.direction[i]) - beta * (u - before));
      if (plain) next = subtract_product(u, v.inverse, vec3(m_.pull[i]));
      if (accelerates) {
        const Vec3<T> g = vec3(Touching ? m_.gradient[i] : m_.pull[i]);
        next = accelerate(u, before, g, theta * v.inverse, T(1) + beta);
      }
      w_.v.set(i, v.hold(v.target, v.project(w_.contacts, next, u)));
    });
  }

  // the last trial counts only if it is better than the base
  PD_DEVICE void settle() {
    if (!c_.done) {
      evaluate(0);
      judge(0);
    }
    const bool keeps = !c_.done && c_.accepted;
    if (!keeps) each_vertex([&](int i) { w_.v.set(i, vec3(m_.base[i])); });
    if (is_first()) {
      w_.progress.schedule.restarts = c_.outer.restarts;
      w_.progress.done = c_.done;
    }
    team_.barrier();
  }

 private:
  PD_DEVICE bool is_first() const { return team_.thread() == 0; }
  PD_DEVICE std::int64_t vertices() const { return w_.plan.vertices; }
  PD_DEVICE double* row(int number) const { return m_.row_sums + number * sums_count; }
  PD_DEVICE static Vec3<T> none() { return {T(0), T(0), T(0)}; }

  PD_DEVICE void look_at(int i, const Vec3<T>& force, ThreadSums& sums) const {
    const auto seen = w_.v.see(i);
    const auto& v = seen.vertex;
    sums.value[0] += seen.energy();
    m_.fresh[i] = quad(v.unbalanced(w_.contacts, seen.u, force));
    if constexpr (Touching) {
      m_.fresh_free[i] = v.free_directions(w_.contacts, seen.u, force);
      m_.fresh_gradient[i] = quad(v.gradient(seen.u, force));
      // work against the friction of the base
      if (!c_.outer.known) return;
      const Vec3<T> friction = open(i, vec3(m_.pull[i]) - vec3(m_.gradient[i]));
      sums.value[1] += double(dot(friction, seen.u - vec3(m_.base[i])));
    }
  }

  template <class Visit>
  PD_DEVICE void each_vertex(const Visit& visit) {
    for (int i = team_.thread(); i < w_.plan.vertices; i += team_.threads()) visit(i);
    team_.barrier();
  }

  // visit(vertex, sums), chunk by chunk, a warp each; then the totals are in c_.total
  template <int Count, class Visit>
  PD_DEVICE void pass(const Visit& visit) {
    const int chunk = call_.chunk(), chunks = call_.chunks(), lane = threadIdx.x % warp_size;
    // nobody overwrites what others may still read
    parity_ = !parity_;
    double* dots = m_.chunk_dots + (parity_ ? std::int64_t(chunks) * outer_dots : 0);
    for (int number = team_.warp(); number < chunks; number += team_.warps()) {
      double sum[Count] = {};
      const int end = min((number + 1) * chunk, w_.plan.vertices);
      for (int i = number * chunk + lane; i < end; i += warp_size) visit(i, sum);
#pragma unroll
      for (int d = 0; d < Count; ++d) {
        const double total = across_warp(sum[d], Add{});
        if (lane == 0) dots[number * outer_dots + d] = total;
      }
    }
    team_.barrier();
    for (int d = threadIdx.x / warp_size; d < Count; d += blockDim.x / warp_size) {
      double sum = 0;
      for (int number = lane; number < chunks; number += warp_size)
        sum += dots[number * outer_dots + d];
      sum = across_warp(sum, Add{});
      if (lane == 0) c_.total[d] = sum;
    }
    __syncthreads();
  }

  // the soft stop, by a trial that it went on from
  PD_DEVICE void stop(int k, double change, double length) {
    const double tolerance = w_.settings().tolerance;
    if (k > 0 && c_.accepted && tolerance > 0 && change <= tolerance * tolerance * length)
      c_.done = true;
  }

  PD_DEVICE void remember(int k) {
    double with[history];
    for (int j = 0; j < history; ++j) {
      with[j] = c_.total[j];
      c_.pairs.pulled[j] = c_.total[history + j];
    }
    c_.pairs.valid[newest_] = false;
    if (k > 0) c_.pairs.add(newest_, with, c_.total[2 * history], c_.total[2 * history + 2]);
    if (c_.outer.plain || c_.outer.diagonal) c_.pairs.clear();
    c_.pairs.first_loop(newest_);
  }

  // the second loop of L-BFGS, and the slope g.d
  PD_DEVICE void correct() {
    pass<history>([&](int i, double (&sum)[history]) {
      const Vec3<T> z = cycle_.result(i);
#pragma unroll
      for (int j = 0; j < history; ++j) {
        if (c_.pairs.valid[j]) sum[j] += double(dot(vec3(m_.y[j * vertices() + i]), z));
      }
    });
    if (threadIdx.x == 0) {
      double with[history];
      for (int j = 0; j < history; ++j) with[j] = c_.total[j];
      c_.pairs.second_loop(newest_, with, c_.factor);
    }
    __syncthreads();
    pass<1>([&](int i, double (&sum)[1]) {
      Vec3<T> d = cycle_.result(i);
#pragma unroll
      for (int j = 0; j < history; ++j) {
        if (c_.pairs.valid[j]) d = multiply_add(T(c_.factor[j]), vec3(m_.s[j * vertices() + i]), d);
      }
      m_.direction[i] = quad(d);
      sum[0] += double(dot(vec3(m_.pull[i]), way(i, d)));
    });
    if (threadIdx.x == 0) {
      Outer& outer = c_.outer;
      outer.slope = c_.total[0];
      // not downhill: what was learnt does not hold here
      if (!(outer.slope >= 0 || outer.plain || outer.diagonal)) {
        c_.pairs.clear();
        outer.plain = true;
        ++outer.restarts;
      }
    }
    __syncthreads();
  }

  PD_DEVICE bool is_stranger(int i) const {
    return w_.v.before[i].w > T(known_inertia) * w_.plan.levels.reference_inertia[i] * trusted_;
  }

  // the part of a field along which contacts let a vertex go
  PD_DEVICE Vec3<T> open(int i, const Vec3<T>& field) const {
    if constexpr (!Touching) return field;
    return m_.free[i] * field;
  }

  // the part of a field that M is to work on: not across contacts, nor where it knows nothing of a pin
  PD_DEVICE Vec3<T> let_through(int i, const Vec3<T>& field) const {
    return open(i, strangers_ && is_stranger(i) ? none() : field);
  }

  // the same before the first base is there, where nothing has moved yet
  PD_DEVICE Vec3<T> let_through(int i, const Vec3<T>& field, int k) const {
    return k == 0 ? none() : let_through(i, field);
  }

  PD_DEVICE void keep_directions(int i, int k) const {
    if (!c_.accepted && k > 0) return;
    m_.gradient[i] = m_.fresh_gradient[i];
    m_.free[i] = m_.fresh_free[i];
  }

  // A way that M has a say on, where it has: the rest goes along the pull, by the diagonal.
  PD_DEVICE Vec3<T> way(int i, const Vec3<T>& d) const {
    const Vec3<T> plain = w_.v.u[i].w * vec3(m_.pull[i]);
    if (!(w_.plan.levels.fine_inverse[i] > T(0))) return plain;
    if (strangers_ && is_stranger(i)) return plain;
    if constexpr (!Touching) return d;
    return open(i, d) + (plain - open(i, plain));
  }

  const OuterCall<T>& call_;
  const StreamWork<T, Touching> w_;
  const OuterMemory<T>& m_;
  BlockTeam& team_;
  OuterControl<T>& c_;
  DeviceCycle<T> cycle_;
  std::byte* shared_;
  bool lbfgs_, strangers_;
  T trusted_;
  int newest_ = 0;
  bool parity_ = false;
};

}  // namespace pd::inline PD_TARGET
