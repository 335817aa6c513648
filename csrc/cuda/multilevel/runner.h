// Runs solver/multilevel/lbfgs.h on a GPU: all iterations of one environment by a team of blocks; see
// also cpu/multilevel/stepper.h. Other parts of a step are launches of their own, as in cuda/stream/kernels.h.
#pragma once
#include "cuda/multilevel/call.h"
#include "cuda/multilevel/pieces_build.h"
#include "cuda/stream/shared_vertices.h"
#include "solver/multilevel/trial_vertex.h"

#include <type_traits>

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, int Threads>
class MultilevelRunner {
  static constexpr int warps = Threads / warp_size;
  struct Nothing {};

 public:
  PD_DEVICE MultilevelRunner(const MultilevelCall<T>& call, const MultilevelMemory<T>& memory,
                             std::int64_t environment, BlockTeam& team, MultilevelControl& control,
                             std::byte* shared)
      : call_(call),
        w_(call.stream, environment),
        m_(memory),
        team_(team),
        c_(control),
        cycle_(call.plan().levels, memory.cycle, team,
               reinterpret_cast<Quad<T>*>(control.warp_dot)),
        shared_(shared),
        lbfgs_(call.stream.step.settings.learns()),
        has_space_(call.shared_pieces > 0),
        pieces_(*reinterpret_cast<PiecesControl<T>*>(shared + call.shared_pieces)) {
    const MaterialMismatch& mismatch = m_.mismatch[environment];
    outliers_ = {mismatch.has_outliers, T(mismatch.trusted)};
    if (threadIdx.x == 0) {
      const bool stops = w_.settings().tolerance > 0;
      c_.outer.begin(mismatch, HasContacts, w_.contacts.friction() > T(0), lbfgs_,
                     energy_noise<T>(), stops ? w_.progress.stop.free_fall : 0);
      c_.pairs = {};
      c_.done = false;
    }
    if (is_first()) w_.progress.schedule.rho = mismatch.spread;
    __syncthreads();
  }

  PD_DEVICE bool finished() const { return c_.done; }

  // Computes energy and residual at the trial u, and the dot products of the newest secant pair
  // with the others.
  PD_DEVICE void evaluate(int k);  // cuda/multilevel/trial.h

  // Decides whether to accept the trial. Every block reduces the same sums, so all blocks decide
  // alike.
  PD_DEVICE void accept_or_reject(int) {
    // adds the patches' sums to those of the shared vertices
    double sum[2] = {patch_sum_[0], patch_sum_[1]};
    warp_reduce_sums(sum);
    const int warp = threadIdx.x / warp_size, lane = threadIdx.x % warp_size;
    if (lane == 0) {
      for (int n = 0; n < 2; ++n) c_.warp_dot[warp][n] = sum[n];
    }
    __syncthreads();
    if (warp == 0) {
      for (int n = 0; n < 2; ++n) sum[n] = lane < warps ? c_.warp_dot[lane][n] : 0;
      warp_reduce_sums(sum);
    }
    if (threadIdx.x == 0) {
      const double work = c_.outer.known ? c_.total[dots_energy + 1] + sum[1] : 0;
      const double energy = (c_.total[dots_energy] + sum[0]) + work;
      c_.accepted = c_.outer.accept(energy, work);
    }
    __syncthreads();
    const bool moves = c_.accepted;
    if (moves && !(c_.total[dots_free_change] == 0)) holds_ = false;
    iterate_ = moves ? w_.v.u : m_.iterate;
    residual_ = moves ? m_.trial_residual : m_.residual;
    free_ = moves ? m_.trial_free : m_.free;
  }

  // Adds the secant pair from the iterate to the trial, accepted or not: it describes the curvature
  // in between.
  PD_DEVICE void update_pairs(int k) {
    if (threadIdx.x < warp_size) {
      if (lbfgs_) store_pair(k);
      if (threadIdx.x == 0) {
        c_.outer.add_path(c_.total[dots_change]);
        stop(k, c_.total[dots_change], c_.total[dots_displacement]);
      }
      __syncwarp();
      if (lbfgs_) SecantPairLanes(c_.pairs, newest_).first_loop();
    }
    __syncthreads();
  }

  PD_DEVICE bool uses_jacobi() const { return lbfgs_ && c_.outer.jacobi; }

  PD_DEVICE void precondition();  // cuda/multilevel/direction.h

  // Computes the next trial, projected out of the contacts: u + beta (u - before) - (1 + beta) t d,
  // or a Jacobi iteration, plain or accelerated.
  PD_DEVICE void next_trial() {
    __syncthreads();
    if (threadIdx.x == 0)
      c_.total[0] =
          c_.outer.propose(w_.progress.schedule.limit, made_, has_space_ && !made_, is_held());
    ++used_;
    __syncthreads();
    const bool accelerates = c_.outer.accelerates(),
               falls_back = accelerates || c_.outer.plain_jacobi;
    const T beta = T(c_.total[0]), length = T((1 + c_.total[0]) * c_.outer.trial_length());
    const T theta = T(w_.settings().relaxation);
    const bool moved = c_.accepted;
    each_vertex([&](int i) {
      const auto v = w_.v.at(i);
      const auto at = trial_vertex(v, i);
      // the previous iterate, for momentum
      const Vec3<T> before = vec3(iteration_ == 0 ? w_.v.u[i]
                                  : moved         ? m_.iterate[i]
                                                  : w_.v.before[i]);
      if constexpr (HasContacts) accept_contact_state(i);
      const Vec3<T> slope = HasContacts ? vec3(m_.gradient[i]) : at.residual;
      const Vec3<T> next =
          falls_back
              ? at.jacobi(w_.contacts, before, slope, accelerates, theta, T(1) + beta)
              : v.project_trial(
                    w_.contacts,
                    at.iterate - completed(i, length * direction(i) - beta * (at.iterate - before)),
                    at.iterate, slope);
      if (moved) w_.v.set_before(i, before);
      m_.iterate[i] = quad(at.iterate);
      m_.residual[i] = quad(at.residual);
      w_.v.set(i, v.hold(v.target, next));
    });
    iterate_ = m_.iterate;
    residual_ = m_.residual;
    free_ = m_.free;
  }

  // Returns the last trial if it was accepted, else the iterate; NaN if the energy is not finite.
  PD_DEVICE void keep_best() {
    const T lost = c_.outer.energy < HUGE_VAL ? T(0) : T(NAN);
    const Vec3<T> none = {lost, lost, lost};
    if (!c_.accepted || !(lost == T(0)))
      each_vertex([&](int i) { w_.v.set(i, vec3(m_.iterate[i]) + none); });
    if (is_first()) {
      w_.progress.schedule.restarts = c_.outer.restarts;
      w_.progress.done = c_.done;
      w_.progress.used = used_;
    }
    team_.barrier();
  }

 private:
  PD_DEVICE bool is_first() const { return team_.thread() == 0; }
  PD_DEVICE std::int64_t vertices() const { return w_.plan.vertices; }
  PD_DEVICE static Vec3<T> none() { return {T(0), T(0), T(0)}; }

  // whether contacts or pins that M does not know hold vertices, and the coarse space includes them
  PD_DEVICE bool is_held() const { return made_ && (outliers_.some || pieces_.held); }

  template <class Visit>
  PD_DEVICE void each_vertex(const Visit& visit) {
#pragma unroll 1
    for (int i = team_.thread(); i < w_.plan.vertices; i += team_.threads()) visit(i);
    team_.barrier();
  }

  // Calls visit(vertex, sums) for all vertices and reduces the sums into c_.total. `Sum`: type of
  // the warp sums.
  template <int Count, class Sum, class Visit>
  PD_DEVICE void pass(const Visit& visit) {
    pass<Count, Sum>(visit, Nothing{});
  }

  // The same, one chunk of vertices at a time, one vertex per lane. Before each round, all threads
  // of the block call prepare(number of vertices, vertex of index).
  template <int Count, class Sum, class Visit, class Prepare>
  PD_DEVICE void pass(const Visit& visit, const Prepare& prepare) {
    const int count = w_.plan.vertices;
    const int chunk_warps = call_.warps_of_chunk(), chunks = call_.chunks_of(count, chunk_warps);
    const int groups = warps / chunk_warps;  // chunks in progress per block
    const int warp = threadIdx.x / warp_size, lane = threadIdx.x % warp_size;
    // double buffer: other blocks may still read the previous sums
    parity_ = !parity_;
    double* dots = m_.chunk_dots + (parity_ ? std::int64_t(call_.chunks()) * most_sums : 0);
    // consecutive chunks lie in different blocks, so a few chunks spread over all multiprocessors
    const auto chunk_of = [&](int round, int group) {
      return (round * groups + group) * team_.blocks() + team_.rank();
    };
#pragma unroll 1
    for (int round = 0; chunk_of(round, 0) < chunks; ++round) {
      if constexpr (!std::is_same_v<Prepare, Nothing>) {
        const int each = chunk_warps * warp_size;  // vertices of a chunk
        const int chunks_left = (chunks - chunk_of(round, 0) + team_.blocks() - 1) / team_.blocks();
        prepare(min(groups, chunks_left) * each,
                [&](int t) { return chunk_of(round, t / each) * each + t % each; });
        __syncthreads();
      }
      Sum sum[Count] = {};
      const int from =
          (chunk_of(round, warp / chunk_warps) * chunk_warps + warp % chunk_warps) * warp_size;
      if (from < count) {
        if (from + lane < count) visit(from + lane, sum);
      }
      write_warp_sums(sum, c_.warp_dot[warp]);
      __syncthreads();
      const int group = threadIdx.x / Count, d = threadIdx.x % Count;
      if (group < groups && chunk_of(round, group) < chunks) {
        double total = 0;
        for (int w = 0; w < chunk_warps; ++w) total += c_.warp_dot[group * chunk_warps + w][d];
        dots[d * chunks + chunk_of(round, group)] = total;
      }
      __syncthreads();
    }
    team_.barrier();
    constexpr int each = (Count + warps - 1) / warps;  // sums per warp
    double sum[each] = {};
    constexpr int in_flight = 4;
#pragma unroll 1
    for (int chunk = lane; chunk < chunks; chunk += in_flight * warp_size) {
      double part[in_flight][each];
#pragma unroll
      for (int u = 0; u < in_flight; ++u) {
#pragma unroll
        for (int n = 0; n < each; ++n)
          part[u][n] = dots[min(warp + n * warps, Count - 1) * chunks +
                            min(chunk + u * warp_size, chunks - 1)];
      }
#pragma unroll
      for (int u = 0; u < in_flight; ++u) {
#pragma unroll
        for (int n = 0; n < each; ++n) sum[n] += chunk + u * warp_size < chunks ? part[u][n] : 0;
      }
    }
    warp_reduce_sums(sum);
#pragma unroll
    for (int n = 0; n < each; ++n) {
      if (lane == 0 && warp + n * warps < Count) c_.total[warp + n * warps] = sum[n];
    }
    __syncthreads();
  }

  // Applies the tolerance, from the change of a trial, accepted or not.
  PD_DEVICE void stop(int k, double change, double displacement) {
    const double tolerance = w_.settings().tolerance;
    if (!(tolerance > 0) || k == 0) return;
    c_.done = c_.outer.is_met(tolerance, w_.progress.schedule, change, displacement);
  }

  // Called by one warp, one lane per secant pair.
  PD_DEVICE void store_pair(int k) {
    const int j = int(threadIdx.x);
    SecantPairs& pairs = c_.pairs;
    if (j < history) {
      pairs.product[j][newest_] = c_.total[dots_sy + j];
      if (c_.accepted) {
        pairs.s_dot_g[j] = c_.total[dots_sg + j];
      } else if (j == newest_) {
        pairs.s_dot_g[j] = c_.total[dots_s_residual];
      }
    }
    if (j != 0) return;
    // s.y of c_.total: another lane has just written that of the table
    pairs.admit(newest_, k > 0 && c_.accepted, c_.total[dots_sy + newest_], c_.total[dots_change],
                c_.total[dots_yy]);
    if (c_.outer.clears_pairs()) pairs.clear();
  }

  PD_DEVICE void accept_contact_state(int i) const {
    if (!c_.accepted) return;
    m_.gradient[i] = m_.trial_gradient[i];
    m_.friction[i] = m_.trial_friction[i];
    m_.free[i] = m_.trial_free[i];
  }

  // The vertex's update from the current iterate.
  PD_DEVICE TrialVertex<Thread<T>, HasContacts> trial_vertex(
      const Vertex<Thread<T>, HasContacts>& v, int i) const {
    return {v, vec3(iterate_[i]), vec3(residual_[i]), free_ + i, w_.plan.levels, i, outliers_};
  }
  // TrialVertex::completed, with loads as late as possible: held in registers, the values would
  // spill.
  PD_DEVICE Vec3<T> completed(int i, const Vec3<T>& d) const {
    const auto free = [&](const Vec3<T>& field) { return free_[i] * field; };
    const Vec3<T> diagonal = w_.v.u[i].w * vec3(residual_[i]);
    if (outliers_.some && is_outlier(i)) return diagonal;
    if constexpr (!HasContacts) return d;
    return free(d) + (diagonal - free(diagonal));
  }
  PD_DEVICE bool is_outlier(int i) const {
    if (!(w_.plan.levels.fine_inverse[i] > T(0))) return true;
    return w_.v.inertia(i) >
           T(outlier_ratio) * w_.plan.levels.reference_inertia[i] * outliers_.trusted;
  }
  PD_DEVICE Vec3<T> restricted(int i, const Vec3<T>& field) const {
    return trial_vertex(w_.v.at(i), i).restricted(field);
  }

  // ---- trials: cuda/multilevel/trial.h

  PD_DEVICE void evaluate_vertex(int i,
                                 const typename Vertices<T, HasContacts>::LoadedVertex& loaded,
                                 const Vec3<T>& force, ThreadSums& sums) const;
  PD_DEVICE void reduce_trial(int k);

  // ---- search direction: cuda/multilevel/direction.h

  PD_DEVICE void find_space();
  PD_DEVICE Vec3<T> moved(int i) const { return moved_by_pieces(pieces_, w_.plan.levels, i); }
  PD_DEVICE void correct(bool last);
  PD_DEVICE Vec3<T> direction(int i) const;
  PD_DEVICE void load_pairs(const Quad<T>* field, int i, Vec3<T> (&loaded)[history]) const;

  const MultilevelCall<T>& call_;
  const StreamWork<T, HasContacts> w_;
  const MultilevelMemory<T>& m_;
  BlockTeam& team_;
  MultilevelControl& c_;
  DeviceCycle<T> cycle_;
  std::byte* shared_;
  bool lbfgs_, has_space_;
  bool made_ = false;   // the step has made the coarse space
  bool holds_ = false;  // it includes the contacts at the iterate
  PiecesControl<T>& pieces_;
  Outliers<T> outliers_;
  // current iterate and residual; they point to the accepted trial until the next trial is written
  const Quad<T>*iterate_ = nullptr, *residual_ = nullptr;
  const Mat3<T>* free_ = nullptr;
  double patch_sum_[2] = {0, 0};
  int newest_ = 0, iteration_ = 0, used_ = 0;
  bool parity_ = false;
};

}  // namespace pd::inline PD_TARGET
