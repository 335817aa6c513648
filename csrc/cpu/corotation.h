// The small problem of solver/corotation.h on the CPU: how it is made of an iterate, and how it acts on vectors.
#pragma once
#include "cpu/assembly.h"
#include "cpu/team.h"
#include "cpu/workspace.h"
#include "solver/corotation.h"
#include "solver/multilevel.h"

#include <algorithm>
#include <array>
#include <cstring>

namespace pd::inline PD_TARGET {

// Zeroed items, aligned for vectors.
template <class Item>
class Row {
 public:
  explicit Row(std::size_t count)
      : count_(count),
        storage_(allocate_zeroed(count * sizeof(Item))),
        items_(reinterpret_cast<Item*>(storage_.get())) {}

  Item& operator[](std::size_t i) const { return items_[i]; }
  Item* begin() const { return items_; }
  Item* end() const { return items_ + count_; }

 private:
  std::size_t count_;
  Storage storage_;
  Item* items_;
};

// One environment's elements, whichever way lanes run elsewhere: sums of products of strains of all modes, patch by patch.
template <class T>
class TurningElements {
 public:
  // `memory`: three times the most slots of a patch
  TurningElements(const Plan<T>& plan, const T* weights, Quad<T>* memory)
      : plan_(plan),
        weights_(weights),
        position_(memory),
        first_(position_ + plan.most_slots),
        last_(first_ + plan.most_slots) {}

  // `position(slot)`: relative to the patch; `shift`: of that to the middle of the turns; `weight_of(vertex, group)`
  template <class Position, class Weight>
  void add(int patch, const Position& position, const Vec3<T>& shift, const Weight& weight_of,
           std::array<double, turning_pairs>& to) {
    const int first = plan_.patch_slot[patch], count = plan_.patch_slot[patch + 1] - first;
    for (int slot = 0; slot < count; ++slot) {
      const int vertex = plan_.slot_vertex[first + slot];
      position_[slot] = position(first + slot);
      first_[slot] = to_quad(weight_of(vertex, 0), weight_of(vertex, 1), weight_of(vertex, 2));
      last_[slot] = to_quad(weight_of(vertex, 3), T(0), T(0));
    }
    using R = typename ElementsAcross<3, T>::R;
    R sum[turning_pairs];
    for (R& s : sum) s = R(T(0));
    const Quad<T>* const fields[3] = {position_, first_, last_};
    LaneSums<Single<T>> unused;
    const Vec3<R> to_middle = {R(shift.x), R(shift.y), R(shift.z)};
    each_element(
        plan_, patch, ElementsAcross<3, T>(plan_, fields, weights_, false, nullptr, unused),
        one_by_one([&](const auto& elements, int s) {
          Vec3<R> x[4], some[4], rest[4];
          elements.corners(s, 0, x);
          elements.corners(s, 1, some);
          elements.corners(s, 2, rest);
          const Mat3<R> inverse = elements.rest(s);
          const Mat3<R> turn = nearest_rotation(deformation_gradient(x, inverse));
          R weight[turning_groups][4];
          for (int c = 0; c < 4; ++c) {
            weight[0][c] = some[c].x;
            weight[1][c] = some[c].y;
            weight[2][c] = some[c].z;
            weight[3][c] = rest[c].x;
            x[c] = x[c] + to_middle;
          }
          const Mat3<R> back = transpose(turn);
          const auto strain = [&](int k) {
            return TurningStrain<R>(TurningGradient<R>(inverse, back, x, weight[k]));
          };
          add_strains({strain(0), strain(1), strain(2), strain(3)}, elements.weight(s), sum);
        }));
    for (int p = 0; p < turning_pairs; ++p) {
      to[p] = 0;
      for (int lane = 0; lane < R::width; ++lane) to[p] += double(sum[p].v[lane]);
    }
  }

 private:
  // Groups with groups before them, and the modes of each where they meet: of six numbers half are none. The order of pairs is
  // that of `turning_pair`.
  template <class R>
  static void add_strains(const TurningStrain<R> (&strain)[turning_groups], const R& weight,
                          R (&sum)[turning_pairs]) {
    for (int k = 0; k < turning_groups; ++k) {
      R own[6][6];
      for (int i = 0; i < 6; ++i) {
        for (int c = 0; c < 6; ++c) own[i][c] = weight * strain[k].h[i][c];
      }
      for (int l = 0; l < k; ++l) {
        R* to = sum + turning_pair(6 * k, 6 * l);
        add_group<false>(own, strain[l].h, to);
      }
      add_group<true>(own, strain[k].h, sum + turning_pair(6 * k, 6 * k));
    }
  }

  template <bool Same, class R>
  static void add_group(const R (&own)[6][6], const R (&other)[6][6], R* sum) {
    PD_UNROLL
    for (int i = 0; i < 6; ++i) {
      PD_UNROLL
      for (int j = 0; j < (Same ? i + 1 : 6); ++j) {
        R& to = sum[Same ? i * (i + 1) / 2 + j : 6 * i + j];
        add_strain_product(own[i], i, other[j], j, to);
      }
    }
  }

  const Plan<T>& plan_;
  const T* weights_;
  Quad<T>*position_, *first_, *last_;
};

// Memory of it, for all threads of a team; none where it is not `wanted`.
template <class Lanes>
struct CorotationWork {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  static constexpr int width = Lanes::environments, chunk = 256;

  struct Numbers {
    Real of[turning_numbers];
  };
  struct Products {
    double inertia[turning_numbers][turning_numbers], matrix[turning_numbers][turning_numbers];
  };
  struct Inverses {
    TurningMatrix energy, matrix;  // Hc^-1, Ac^-1
  };

  int chunks;
  Row<Numbers> numbers, images;                    // [vertices] (w, w r), and A times them
  Row<typename Lanes::Value> sums;                 // [chunks, turning_numbers]
  Row<Products> products;                          // [chunks]
  Row<std::array<double, turning_pairs>> strains;  // [patches]
  Row<Inverses> inverse;                           // [environments]
  Row<Quad<T>> slots;                              // [threads, 3, most slots of a patch]
  Row<T> weights;  // [elements] of one environment, where they differ

  CorotationWork(const Plan<T>& plan, bool wanted, int threads)
      : chunks(wanted ? (plan.vertices + chunk - 1) / chunk : 0),
        numbers(wanted ? plan.vertices : 0),
        images(wanted ? plan.vertices : 0),
        sums(std::size_t(chunks) * turning_numbers),
        products(chunks),
        strains(wanted ? plan.patches : 0),
        inverse(wanted ? width : 0),
        slots(wanted ? std::size_t(threads) * 3 * plan.most_slots : 0),
        weights(wanted && width > 1 ? std::size_t(plan.blocks) * block_lanes : 0) {}
};

// One thread's part in it.
template <class Lanes>
class Corotation {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Shared = CorotationWork<Lanes>;
  static constexpr int width = Lanes::environments;

 public:
  Corotation(const Plan<T>& plan, const Team& team, const Workspace<Lanes>& work, Shared& shared)
      : plan_(plan), team_(team), w_(work), shared_(shared) {}

  // Makes it for the lanes that ask, of positions x + u: `base` is u. Their material is that of A times `scales` at most.
  void make(const Value* base, const bool (&asks)[width], const double (&scales)[width]) {
    for (int lane = 0; lane < width; ++lane) Lanes::set_lane(wanted_, lane, T(asks[lane] ? 1 : 0));
    find_middle();
    each_vertex([&](std::int64_t i) { set_numbers(i, base); });
    each_vertex([&](std::int64_t i) { set_image(i); });
    for (int lane = 0; lane < width; ++lane) {
      if (!asks[lane]) continue;
      for (std::int64_t c = team_.begin(shared_.chunks); c < team_.end(shared_.chunks); ++c)
        add_products_of(c, lane);
      add_elements(lane, base);
      team_.barrier();
      if (team_.rank == 0) solve(lane, scales[lane]);
      team_.barrier();
    }
  }

  void forget(int lane) const {
    if (team_.rank == 0) shared_.inverse[lane] = {};
  }

  // before M: V^T q
  void measure(const Value* q) {
    sum_up(shared_.numbers, q, own_);
    double part[width][turning_modes];
    for (int lane = 0; lane < width; ++lane)
      shared_.inverse[lane].matrix.multiply(own_[lane], part[lane]);
    set_vectors(part);
  }
  // (I - A V Ac^-1 V^T) q
  Value without(std::int64_t i, Value q) const {
    for (int m = 0; m < turning_numbers; ++m)
      q = subtract_product(q, shared_.images[i].of[m], vector_[m]);
    return q;
  }

  // The same with M = A^-1: its result lacks V (Hc^-1 - Ac^-1) V^T q, since M A V = V, whatever the order.
  void measure_direct(const Value* q, const Real& scale) {
    sum_up(shared_.numbers, q, own_);
    double soft[turning_modes], part[width][turning_modes];
    for (int lane = 0; lane < width; ++lane) {
      shared_.inverse[lane].energy.multiply(own_[lane], soft);
      shared_.inverse[lane].matrix.multiply(own_[lane], part[lane]);
      for (int m = 0; m < turning_modes; ++m)
        part[lane][m] = soft[m] / number(scale, lane) - part[lane][m];
    }
    set_vectors(part);
  }

  // After it: what its result lacks. q came multiplied by `scale`.
  void answer(const Value* z, const Real& scale) {
    double image[width][turning_modes], soft[turning_modes], part[width][turning_modes];
    sum_up(shared_.images, z, image);
    for (int lane = 0; lane < width; ++lane) {
      shared_.inverse[lane].energy.multiply(own_[lane], soft);
      shared_.inverse[lane].matrix.multiply(image[lane], part[lane]);
      for (int m = 0; m < turning_modes; ++m)
        part[lane][m] = soft[m] / number(scale, lane) - part[lane][m];
    }
    set_vectors(part);
  }
  Value with(std::int64_t i, Value z) const {
    for (int m = 0; m < turning_numbers; ++m)
      z = multiply_add(shared_.numbers[i].of[m], vector_[m], z);
    return z;
  }

 private:
  template <class Visit>
  void each_vertex(Visit visit) const {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) visit(i);
    team_.barrier();
  }

  // visit(vertex) of a chunk
  template <class Visit>
  void each_of_chunk(std::int64_t chunk, Visit visit) const {
    const std::int64_t end = std::min<std::int64_t>(plan_.vertices, (chunk + 1) * Shared::chunk);
    for (std::int64_t i = chunk * Shared::chunk; i < end; ++i) visit(i);
  }

  // Any place amid the vertices will do. What is held has no part in it, be it NaN.
  void find_middle() {
    for (int lane = 0; lane < width; ++lane) {
      double sum[3] = {}, count = 0;
      for (int i = 0; i < plan_.vertices; ++i) {
        if (!(number(w_.inverse[i], lane) > 0)) continue;
        const Vec3<T> x = Lanes::get_lane(w_.x[i], lane);
        sum[0] += double(x.x);
        sum[1] += double(x.y);
        sum[2] += double(x.z);
        ++count;
      }
      const double share = count > 0 ? 1 / count : 0;
      Lanes::set_lane(middle_, lane, T(share * sum[0]), T(share * sum[1]), T(share * sum[2]));
    }
  }

  void set_numbers(std::int64_t i, const Value* base) const {
    const Vec3<Real> r = Lanes::vec3((w_.x[i] - middle_) + base[i]);
    const T* weight = plan_.levels.turning_weight + 4 * i;
    const bool known = plan_.levels.fine_inverse[i] > T(0);
    const Real none(T(0));
    for (int k = 0; k < turning_groups; ++k) {
      const Real own(known ? weight[k] : T(0));
      const Real numbers[4] = {own, own * r.x, own * r.y, own * r.z};
      // what is held, here or by what M was made of, turns with nothing
      for (int c = 0; c < 4; ++c)
        renew(shared_.numbers[i].of[4 * k + c],
              select(w_.inverse[i] > none, known ? numbers[c] : none, none));
    }
  }

  void set_image(std::int64_t i) const {
    const Level<1, T> level = fine_level(plan_.levels);
    Real sum[turning_numbers];
    for (Real& s : sum) s = Real(T(0));
    for (int32 p = level.start[i]; p < level.start[i + 1]; ++p) {
      const Real* from = shared_.numbers[level.column[p]].of;
      const Real a(level.value[p]);
      for (int m = 0; m < turning_numbers; ++m) sum[m] = multiply_add(a, from[m], sum[m]);
    }
    for (int m = 0; m < turning_numbers; ++m) renew(shared_.images[i].of[m], sum[m]);
  }

  // only in lanes that ask
  void renew(Real& old, const Real& fresh) const { old = select(wanted_ > Real(T(0)), fresh, old); }

  double number(const Real& of, int lane) const { return Lanes::lane(Lanes::widen(of), lane); }

  void add_products_of(std::int64_t chunk, int lane) const {
    using Some = Pack<double, native_width<double>>;
    constexpr int packs = turning_numbers / Some::width;
    Some inertia[turning_numbers][packs], matrix[turning_numbers][packs];
    for (int m = 0; m < turning_numbers; ++m) {
      for (int n = 0; n < packs; ++n) inertia[m][n] = matrix[m][n] = Some(0.0);
    }
    each_of_chunk(chunk, [&](std::int64_t i) {
      double own[turning_numbers], image[turning_numbers];
      for (int m = 0; m < turning_numbers; ++m) {
        own[m] = number(shared_.numbers[i].of[m], lane);
        image[m] = number(shared_.images[i].of[m], lane);
      }
      Some owns[packs], images[packs];
      for (int n = 0; n < packs; ++n) {
        owns[n] = Some::load(own + n * Some::width);
        images[n] = Some::load(image + n * Some::width);
      }
      const double a = number(w_.inertia[i], lane);
      for (int m = 0; m < turning_numbers; ++m) {
        const Some light(own[m]), heavy(a * own[m]);
        for (int n = 0; n < packs; ++n) {
          inertia[m][n] = multiply_add(heavy, owns[n], inertia[m][n]);
          matrix[m][n] = multiply_add(light, images[n], matrix[m][n]);
        }
      }
    });
    typename Shared::Products& p = shared_.products[chunk];
    static_assert(sizeof(p.inertia) == sizeof(inertia));
    std::memcpy(p.inertia, inertia, sizeof(inertia));
    std::memcpy(p.matrix, matrix, sizeof(matrix));
  }

  void add_elements(int lane, const Value* base) const {
    const std::int64_t elements = std::int64_t(plan_.blocks) * block_lanes;
    const int lanes = w_.shared_weight ? 1 : width;
    // then the team is one thread
    for (std::int64_t e = 0; lanes > 1 && e < elements; ++e)
      shared_.weights[e] = w_.weight[e * lanes + lane];
    TurningElements<T> work(plan_, lanes > 1 ? shared_.weights.begin() : w_.weight,
                            &shared_.slots[std::size_t(team_.rank) * 3 * plan_.most_slots]);
    for (std::int64_t patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches);
         ++patch) {
      const Value& anchor = w_.x[plan_.slot_vertex[plan_.patch_slot[patch]]];
      const Vec3<T> shift = Lanes::get_lane(anchor - middle_, lane);
      work.add(
          int(patch),
          [&](int slot) {
            const Vec3<T> x =
                Lanes::get_lane(w_.origin[slot] + base[plan_.slot_vertex[slot]], lane);
            return to_quad(x.x, x.y, x.z);
          },
          shift,
          [&](int vertex, int group) {
            return T(number(shared_.numbers[vertex].of[4 * group], lane));
          },
          shared_.strains[patch]);
    }
  }

  void solve(int lane, double times) const {
    typename Shared::Products all = {};
    for (const typename Shared::Products& p : shared_.products) {
      for (int m = 0; m < turning_numbers; ++m) {
        for (int n = 0; n < turning_numbers; ++n) {
          all.inertia[m][n] += p.inertia[m][n];
          all.matrix[m][n] += p.matrix[m][n];
        }
      }
    }
    TurningMatrix energy, matrix;
    for (int i = 0; i < turning_modes; ++i) {
      for (int j = 0; j <= i; ++j) {
        double sum = 0;
        for (const auto& of_patch : shared_.strains) sum += of_patch[turning_pair(i, j)];
        energy.at[i][j] = mode_product(all.inertia, i, j) + sum;
        energy.at[j][i] = mode_product(all.inertia, j, i) + sum;
        matrix.at[i][j] = mode_product(all.matrix, i, j);
        matrix.at[j][i] = mode_product(all.matrix, j, i);
      }
    }
    double scale[turning_modes];
    for (int i = 0; i < turning_modes; ++i) scale[i] = turning_scale(matrix, i);
    typename Shared::Inverses found;
    const bool sound = invert(energy, scale, times * turning_noise, found.energy) &&
                       invert(matrix, scale, turning_noise, found.matrix);
    shared_.inverse[lane] = sound ? found : typename Shared::Inverses{};
  }

  // false where X is not positive
  static bool invert(const TurningMatrix& x, const double (&scale)[turning_modes], double noise,
                     TurningMatrix& inverse) {
    constexpr int n = turning_modes;
    TurningMatrix now, next;
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) now.at[i][j] = scaled_entry(x, scale[i], scale[j], i, j, noise);
    }
    for (int k = 0; k < n; ++k) {
      if (!(now.at[k][k] > 0)) return false;
      const double share = 1 / now.at[k][k];
      for (int i = 0; i < n; ++i) {
        for (int j = 0; j < n; ++j) next.at[i][j] = swept(now, k, share, i, j);
      }
      now = next;
    }
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) inverse.at[i][j] = -scale[i] * scale[j] * now.at[i][j];
    }
    return true;
  }

  // sums of the sixteen numbers times a field, as modes, chunk by chunk: neither threads nor the batch change their order
  void sum_up(const Row<typename Shared::Numbers>& numbers, const Value* field,
              double (&modes)[width][turning_modes]) const {
    const Real none(T(0));
    for (std::int64_t c = team_.begin(shared_.chunks); c < team_.end(shared_.chunks); ++c) {
      Value sum[turning_numbers];
      for (Value& s : sum) s = Lanes::value({none, none, none});
      each_of_chunk(c, [&](std::int64_t i) {
        for (int m = 0; m < turning_numbers; ++m)
          sum[m] = multiply_add(numbers[i].of[m], field[i], sum[m]);
      });
      std::copy_n(sum, turning_numbers, &shared_.sums[c * turning_numbers]);
    }
    team_.barrier();
    for (int lane = 0; lane < width; ++lane) {
      double total[turning_numbers][3] = {};
      for (int c = 0; c < shared_.chunks; ++c) {
        for (int m = 0; m < turning_numbers; ++m) {
          const Vec3<T> sum = Lanes::get_lane(shared_.sums[c * turning_numbers + m], lane);
          total[m][0] += double(sum.x);
          total[m][1] += double(sum.y);
          total[m][2] += double(sum.z);
        }
      }
      modes_of(total, modes[lane]);
    }
    team_.barrier();
  }

  void set_vectors(const double (&modes)[width][turning_modes]) {
    for (int lane = 0; lane < width; ++lane) {
      double vector[turning_numbers][3];
      vectors_of(modes[lane], vector);
      for (int m = 0; m < turning_numbers; ++m)
        Lanes::set_lane(vector_[m], lane, T(vector[m][0]), T(vector[m][1]), T(vector[m][2]));
    }
  }

  const Plan<T>& plan_;
  const Team& team_;
  const Workspace<Lanes>& w_;
  Shared& shared_;
  Real wanted_;
  Value middle_;
  double own_[width][turning_modes] = {};
  Value vector_[turning_numbers];
};

}  // namespace pd::inline PD_TARGET
