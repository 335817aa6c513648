// How the small problem of solver/multilevel/deflation.h is made of an iterate, on the CPU.
#pragma once
#include "cpu/multilevel/deflation_workspace.h"
#include "cpu/step/element_blocks.h"
#include "cpu/step/workspace.h"
#include "elements/solid.h"
#include "solver/multilevel/lbfgs.h"
#include "threads/team.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <type_traits>

namespace pd::inline PD_TARGET {

// Displacements of a vertex by all modes, of its sixteen numbers: w_k e_a and w_k e_a x r. visit(mode, displacement)
template <class Number, class Visit>
void each_mode_at(const Number& number, const Visit& visit) {
  for (int k = 0; k < turning_groups; ++k) {
    const double w = number(4 * k), x = number(4 * k + 1), y = number(4 * k + 2),
                 z = number(4 * k + 3);
    visit(6 * k, Vec3<double>{w, 0, 0});
    visit(6 * k + 1, Vec3<double>{0, w, 0});
    visit(6 * k + 2, Vec3<double>{0, 0, w});
    visit(6 * k + 3, Vec3<double>{0, -z, y});
    visit(6 * k + 4, Vec3<double>{z, 0, -x});
    visit(6 * k + 5, Vec3<double>{-y, x, 0});
  }
}

// One environment's elements, whichever way lanes run elsewhere: sums of products of strains of all modes, patch by patch.
template <class T>
class TurningElements {
 public:
  // `memory`: three times the most slots of a patch
  TurningElements(const Plan<T>& plan, const ElementWeights<T>& weights, Quad<T>* memory)
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
    const ElementsAcross<3, T> elements(plan_, fields, weights_, nullptr, unused);
    each_element(plan_, patch, elements,
                 one_by_one([&](const auto& pack, int s) { add_pack(pack, s, to_middle, sum); }));
    for (int p = 0; p < turning_pairs; ++p) {
      to[p] = 0;
      for (int lane = 0; lane < R::width; ++lane) to[p] += double(sum[p].v[lane]);
    }
  }

 private:
  template <class Elements, class R>
  static void add_pack(const Elements& elements, int s, const Vec3<R>& to_middle,
                       R (&sum)[turning_pairs]) {
    Vec3<R> x[4], some[4], rest[4];
    elements.corners(s, 0, x);
    elements.corners(s, 1, some);
    elements.corners(s, 2, rest);
    const Mat3<R> inverse = elements.rest(s).inverse(0);
    const Mat3<R> back = transpose(nearest_rotation(deformation_gradient(x, inverse)));
    for (Vec3<R>& position : x) position = position + to_middle;
    TurningStrain<R> strain[turning_groups];
    bool present[turning_groups];
    for (int k = 0; k < turning_groups; ++k) {
      R weight[4];
      for (int c = 0; c < 4; ++c)
        weight[c] = k == 0 ? some[c].x : k == 1 ? some[c].y : k == 2 ? some[c].z : rest[c].x;
      present[k] = any((weight[0] + weight[1]) + (weight[2] + weight[3]) > R(T(0)));
      if (present[k]) strain[k] = TurningStrain<R>(TurningGradient<R>(inverse, back, x, weight));
    }
    if (elements.weights.pressure) {
      add_strains<true>(strain, present, elements.weight(s), elements.pressure(s), sum);
    } else {
      add_strains<false>(strain, present, elements.weight(s), R(T(0)), sum);
    }
  }

  // Groups with groups before them, and the modes of each where they meet: of six numbers half are none. The order of pairs is
  // that of `turning_pair`. A pack of elements seldom has all groups; the others would add zeros.
  template <bool Dilates, class R>
  static void add_strains(const TurningStrain<R> (&strain)[turning_groups],
                          const bool (&present)[turning_groups], const R& weight, const R& pressure,
                          R (&sum)[turning_pairs]) {
    for (int k = 0; k < turning_groups; ++k) {
      if (!present[k]) continue;
      R own[6][6];
      for (int i = 0; i < 6; ++i) {
        for (int c = 0; c < 6; ++c) own[i][c] = weight * strain[k].h[i][c];
        if (Dilates) add_dilation(strain[k].h[i], pressure, own[i]);
      }
      for (int l = 0; l < k; ++l) {
        if (!present[l]) continue;
        R* to = sum + turning_pair(6 * k, 6 * l);
        add_group<false, Dilates>(own, strain[l].h, to);
      }
      add_group<true, Dilates>(own, strain[k].h, sum + turning_pair(6 * k, 6 * k));
    }
  }

  template <bool Same, bool Dilates, class R>
  static void add_group(const R (&own)[6][6], const R (&other)[6][6], R* sum) {
    PD_UNROLL
    for (int i = 0; i < 6; ++i) {
      PD_UNROLL
      for (int j = 0; j < (Same ? i + 1 : 6); ++j) {
        R& to = sum[Same ? i * (i + 1) / 2 + j : 6 * i + j];
        add_strain_product<Dilates>(own[i], i, other[j], j, to);
      }
    }
  }

  const Plan<T>& plan_;
  ElementWeights<T> weights_;
  Quad<T>*position_, *first_, *last_;
};

// One thread's part in the making.
template <class Lanes>
class CorotationMaker {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Shared = CorotationWork<Lanes>;
  static constexpr int width = Lanes::environments;

 public:
  CorotationMaker(const Plan<T>& plan, const Team& team, const Workspace<Lanes>& work,
                  Shared& shared)
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

  // Contacts hold a vertex by springs as stiff as its diagonal, in the directions that they do not leave `free`.
  void hold(const Mat3<Real>* free, const bool (&has)[width], const double (&scales)[width]) {
    for (int lane = 0; lane < width; ++lane) {
      if (!has[lane]) continue;
      for (std::int64_t c = team_.begin(shared_.chunks); c < team_.end(shared_.chunks); ++c)
        add_springs_of(c, free, lane);
      team_.barrier();
      if (team_.rank == 0) solve_held(lane, scales[lane]);
      team_.barrier();
    }
  }

 private:
  template <class Visit>
  void each_vertex(Visit visit) const {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) visit(i);
    team_.barrier();
  }

  // Any place amid the vertices will do. What is held has no part in it, be it NaN.
  void find_middle() {
    for (int lane = 0; lane < width; ++lane) {
      double sum[3] = {}, count = 0;
      for (int i = 0; i < plan_.vertices; ++i) {
        if (!(Shared::number(w_.inverse[i], lane) > 0)) continue;
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
    // of one environment several numbers at once
    using Some = std::conditional_t<width == 1, Pack<T, native_width<T>>, Real>;
    constexpr int packs = turning_numbers * sizeof(Real) / sizeof(Some);
    Some sum[packs];
    for (Some& s : sum) s = Some(T(0));
    for (int32 p = level.start[i]; p < level.start[i + 1]; ++p) {
      const T* from = reinterpret_cast<const T*>(shared_.numbers[level.column[p]].of);
      const Some a(level.value[p]);
      for (int n = 0; n < packs; ++n)
        sum[n] = multiply_add(a, Some::load(from + n * Some::width), sum[n]);
    }
    Real found[turning_numbers];
    static_assert(sizeof(found) == sizeof(sum));
    std::memcpy(found, sum, sizeof(sum));
    for (int m = 0; m < turning_numbers; ++m) renew(shared_.images[i].of[m], found[m]);
  }

  // only in lanes that ask
  void renew(Real& old, const Real& fresh) const { old = select(wanted_ > Real(T(0)), fresh, old); }

  void add_products_of(std::int64_t chunk, int lane) const {
    using Some = Pack<double, native_width<double>>;
    constexpr int packs = turning_numbers / Some::width;
    Some inertia[turning_numbers][packs], matrix[turning_numbers][packs];
    for (int m = 0; m < turning_numbers; ++m) {
      for (int n = 0; n < packs; ++n) inertia[m][n] = matrix[m][n] = Some(0.0);
    }
    shared_.each_of_chunk(plan_.vertices, chunk, [&](std::int64_t i) {
      double own[turning_numbers], image[turning_numbers];
      for (int m = 0; m < turning_numbers; ++m) {
        own[m] = Shared::number(shared_.numbers[i].of[m], lane);
        image[m] = Shared::number(shared_.images[i].of[m], lane);
      }
      Some owns[packs], images[packs];
      for (int n = 0; n < packs; ++n) {
        owns[n] = Some::load(own + n * Some::width);
        images[n] = Some::load(image + n * Some::width);
      }
      const double a = Shared::number(w_.inertia[i], lane);
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
    ElementWeights<T> weights = w_.weights();
    if (lanes > 1) {
      T *weight = shared_.weights.begin(), *pressure = weight + elements;
      for (std::int64_t e = 0; e < elements; ++e) weight[e] = w_.weight[e * lanes + lane];
      for (std::int64_t e = 0; w_.pressure && e < elements; ++e)
        pressure[e] = w_.pressure[e * lanes + lane];
      weights = {weight, w_.pressure ? pressure : nullptr, true};
    }
    TurningElements<T> work(plan_, weights,
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
            return T(Shared::number(shared_.numbers[vertex].of[4 * group], lane));
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
    if (shared_.unheld.size() == 0) return;
    typename Shared::Unheld& unheld = shared_.unheld[lane];
    unheld = {energy, {}, sound, false};
    std::copy_n(scale, turning_modes, unheld.scale);
  }

  void add_springs_of(std::int64_t chunk, const Mat3<Real>* free, int lane) const {
    std::array<double, turning_pairs>& sum = shared_.springs[chunk];
    sum.fill(0);
    shared_.each_of_chunk(plan_.vertices, chunk, [&](std::int64_t i) {
      // hardly any vertex is held in any lane
      if (leaves_all(free[i])) return;
      const double inverse = Shared::number(w_.inverse[i], lane);
      if (!(inverse > 0)) return;
      Vec3<double> held[3];  // I - free
      for (int a = 0; a < 3; ++a) {
        const Vec3<Real>& row = free[i].row[a];
        held[a] = {(a == 0) - Shared::number(row.x, lane), (a == 1) - Shared::number(row.y, lane),
                   (a == 2) - Shared::number(row.z, lane)};
      }
      Vec3<double> mode[turning_modes];
      each_mode_at([&](int n) { return Shared::number(shared_.numbers[i].of[n], lane); },
                   [&](int m, const Vec3<double>& d) {
                     mode[m] = {dot(held[0], d), dot(held[1], d), dot(held[2], d)};
                   });
      for (int m = 0; m < turning_modes; ++m) {
        const Vec3<double> force = (1 / inverse) * mode[m];
        for (int n = 0; n <= m; ++n) sum[turning_pair(m, n)] += dot(force, mode[n]);
      }
    });
  }

  // a projector has less than this trace where it takes anything
  static bool leaves_all(const Mat3<Real>& free) {
    const Real trace = (free.row[0].x + free.row[1].y) + free.row[2].z;
    return !any(trace < Real(T(2.5)));
  }

  void solve_held(int lane, double times) const {
    typename Shared::Unheld& unheld = shared_.unheld[lane];
    if (!unheld.sound) return;
    TurningMatrix energy = unheld.energy;
    bool held = false;
    for (int m = 0; m < turning_modes; ++m) {
      for (int n = 0; n <= m; ++n) {
        double sum = 0;
        for (const auto& of_chunk : shared_.springs) sum += of_chunk[turning_pair(m, n)];
        held = held || sum != 0;
        energy.at[m][n] += sum;
        if (n < m) energy.at[n][m] += sum;
      }
    }
    // as it was
    if (!held && !unheld.held) return;
    const double noise = times * turning_noise;
    TurningMatrix& inverse = shared_.inverse[lane].energy;
    unheld.held = held && invert(energy, unheld.scale, noise, inverse);
    if (!unheld.held) invert(unheld.energy, unheld.scale, noise, inverse);
  }

  // false where X is not positive
  static bool invert(const TurningMatrix& x, const double (&scale)[turning_modes], double noise,
                     TurningMatrix& inverse) {
    constexpr int n = turning_modes;
    TurningMatrix now;
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) now.at[i][j] = scaled_entry(x, scale[i], scale[j], i, j, noise);
    }
    // swept(), in place and row by row
    for (int k = 0; k < n; ++k) {
      if (!(now.at[k][k] > 0)) return false;
      const double share = 1 / now.at[k][k];
      double row[n];
      std::copy_n(now.at[k], n, row);
      for (int i = 0; i < n; ++i) {
        const double factor = now.at[i][k];
        for (int j = 0; j < n; ++j) now.at[i][j] -= share * (factor * row[j]);
        now.at[i][k] = share * factor;
      }
      for (int j = 0; j < n; ++j) now.at[k][j] = share * row[j];
      now.at[k][k] = -share;
    }
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) inverse.at[i][j] = -scale[i] * scale[j] * now.at[i][j];
    }
    return true;
  }

  const Plan<T>& plan_;
  const Team& team_;
  const Workspace<Lanes>& w_;
  Shared& shared_;
  Real wanted_;
  Value middle_;
};

}  // namespace pd::inline PD_TARGET
