// Elements of one patch: reads corners, adds forces to the patch's slots in a fixed order.
#pragma once
#include "cpu/step/lanes.h"
#include "elements/solid_pair.h"

namespace pd::inline PD_TARGET {

// The lanes of one block of elements that a pack holds.
template <class T>
struct BlockPart {
  const Plan<T>* plan;
  int block, first_lane;

  PD_HD const int16* corner(int c) const {
    return plan->tet_corner + (std::int64_t(block) * 4 + c) * block_lanes + first_lane;
  }
  PD_HD const T* rest(int number) const {
    return plan->tet_rest + (std::int64_t(block) * 6 + number) * block_lanes + first_lane;
  }
  PD_HD std::int64_t element() const { return std::int64_t(block) * block_lanes + first_lane; }
};

template <class R, class Read>
PD_HD FaceRest<R, 1> read_rest(Read read) {
  return {read(0), read(1), read(2), {{read(3), read(4), read(5)}}};
}

// A corner of W elements, from vertices stored as quads: loads and shuffles beat the gather instructions.
template <class T, int W>
PD_HD Vec3<Pack<T, W>> gather_corner(const Quad<T>* x, const int16* slot) {
#if PD_VECTOR_BYTES == 64
  if constexpr (W == 16 && sizeof(T) == 4) {
    // row[j] holds the quads of lanes j, j + 4, j + 8, j + 12; then 4x4 transposes
    __m512 row[4];
    for (int j = 0; j < 4; ++j) {
      const auto quad = [&](int lane) { return (__m128)x[slot[lane]].q.v; };
      row[j] = _mm512_castps128_ps512(quad(j));
      row[j] = _mm512_insertf32x4(row[j], quad(j + 4), 1);
      row[j] = _mm512_insertf32x4(row[j], quad(j + 8), 2);
      row[j] = _mm512_insertf32x4(row[j], quad(j + 12), 3);
    }
    using V = typename Pack<T, W>::Vector;
    const __m512d xy01 = _mm512_castps_pd(_mm512_unpacklo_ps(row[0], row[1]));
    const __m512d xy23 = _mm512_castps_pd(_mm512_unpacklo_ps(row[2], row[3]));
    const __m512d zw01 = _mm512_castps_pd(_mm512_unpackhi_ps(row[0], row[1]));
    const __m512d zw23 = _mm512_castps_pd(_mm512_unpackhi_ps(row[2], row[3]));
    return {V(_mm512_castpd_ps(_mm512_unpacklo_pd(xy01, xy23))),
            V(_mm512_castpd_ps(_mm512_unpackhi_pd(xy01, xy23))),
            V(_mm512_castpd_ps(_mm512_unpacklo_pd(zw01, zw23)))};
  }
  if constexpr (W == 8 && sizeof(T) == 8) {
    // row[j] holds the quads of lanes j and j + 4; then 4x4 transposes
    __m512d row[4];
    for (int j = 0; j < 4; ++j) {
      row[j] = _mm512_castpd256_pd512((__m256d)x[slot[j]].q.v);
      row[j] = _mm512_insertf64x4(row[j], (__m256d)x[slot[j + 4]].q.v, 1);
    }
    using V = typename Pack<T, W>::Vector;
    const __m512d xz01 = _mm512_unpacklo_pd(row[0], row[1]),
                  xz23 = _mm512_unpacklo_pd(row[2], row[3]);
    const __m512d yw01 = _mm512_unpackhi_pd(row[0], row[1]),
                  yw23 = _mm512_unpackhi_pd(row[2], row[3]);
    // 128-bit pieces of lanes 0-1, 2-3 of x, then of z
    const __m512i low = _mm512_setr_epi64(0, 1, 8, 9, 4, 5, 12, 13);
    const __m512i high = _mm512_setr_epi64(2, 3, 10, 11, 6, 7, 14, 15);
    return {V(_mm512_permutex2var_pd(xz01, low, xz23)), V(_mm512_permutex2var_pd(yw01, low, yw23)),
            V(_mm512_permutex2var_pd(xz01, high, xz23))};
  }
#endif
  Vec3<Pack<T, W>> r;
  for (int lane = 0; lane < W; ++lane) {
    const auto& q = x[slot[lane]].q.v;
    r.x.v[lane] = q[0];
    r.y.v[lane] = q[1];
    r.z.v[lane] = q[2];
  }
  return r;
}

// W vectors, lane by lane, as quads.
template <class T, int W>
PD_HD void store_quads(const Vec3<Pack<T, W>>& a, Quad<T> (&quads)[W]) {
#if PD_VECTOR_BYTES == 64
  if constexpr (W == 16 && sizeof(T) == 4) {
    const __m512 x = (__m512)a.x.v, y = (__m512)a.y.v, z = (__m512)a.z.v, w = _mm512_setzero_ps();
    const __m512d xy_low = _mm512_castps_pd(_mm512_unpacklo_ps(x, y)),
                  xy_high = _mm512_castps_pd(_mm512_unpackhi_ps(x, y));
    const __m512d zw_low = _mm512_castps_pd(_mm512_unpacklo_ps(z, w)),
                  zw_high = _mm512_castps_pd(_mm512_unpackhi_ps(z, w));
    // column[j] holds lanes j, j + 4, j + 8, j + 12
    const __m512 column[4] = {_mm512_castpd_ps(_mm512_unpacklo_pd(xy_low, zw_low)),
                              _mm512_castpd_ps(_mm512_unpackhi_pd(xy_low, zw_low)),
                              _mm512_castpd_ps(_mm512_unpacklo_pd(xy_high, zw_high)),
                              _mm512_castpd_ps(_mm512_unpackhi_pd(xy_high, zw_high))};
    for (int j = 0; j < 4; ++j) {
      quads[j].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf32x4_ps(column[j], 0);
      quads[j + 4].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf32x4_ps(column[j], 1);
      quads[j + 8].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf32x4_ps(column[j], 2);
      quads[j + 12].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf32x4_ps(column[j], 3);
    }
    return;
  }
  if constexpr (W == 8 && sizeof(T) == 8) {
    const __m512d x = (__m512d)a.x.v, y = (__m512d)a.y.v, z = (__m512d)a.z.v,
                  w = _mm512_setzero_pd();
    const __m512d xy_even = _mm512_unpacklo_pd(x, y), xy_odd = _mm512_unpackhi_pd(x, y);
    const __m512d zw_even = _mm512_unpacklo_pd(z, w), zw_odd = _mm512_unpackhi_pd(z, w);
    const __m512i first = _mm512_setr_epi64(0, 1, 8, 9, 4, 5, 12, 13);
    const __m512i second = _mm512_setr_epi64(2, 3, 10, 11, 6, 7, 14, 15);
    const __m512d column[4] = {_mm512_permutex2var_pd(xy_even, first, zw_even),
                               _mm512_permutex2var_pd(xy_odd, first, zw_odd),
                               _mm512_permutex2var_pd(xy_even, second, zw_even),
                               _mm512_permutex2var_pd(xy_odd, second, zw_odd)};
    for (int j = 0; j < 4; ++j) {
      quads[j].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf64x4_pd(column[j], 0);
      quads[j + 4].q.v = (typename Pack<T, 4>::Vector)_mm512_extractf64x4_pd(column[j], 1);
    }
    return;
  }
#endif
  for (int lane = 0; lane < W; ++lane)
    quads[lane] = to_quad(T(a.x.v[lane]), T(a.y.v[lane]), T(a.z.v[lane]));
}

// Adds element after element, corner after corner: the order of a batch.
template <class T, int W>
PD_HD void scatter_corners(Quad<T>* g, const BlockPart<T>& part,
                           const Vec3<Pack<T, W>> (&force)[4]) {
  Quad<T> quads[4][W];
  for (int c = 0; c < 4; ++c) store_quads<T, W>(force[c], quads[c]);
  for (int lane = 0; lane < W; ++lane) {
    for (int c = 0; c < 4; ++c) {
      Quad<T>& to = g[part.corner(c)[lane]];
      to = to + quads[c][lane];
    }
  }
}

// One sum for each lane of the blocks. Both layouts give the total the same bits.
template <class Lanes>
struct LaneSums;
template <class T>
struct LaneSums<Single<T>> {
  using R = Pack<T, native_width<T>>;
  R part[block_lanes / native_width<T>];

  PD_HD void clear() {
    for (R& p : part) p = R(T(0));
  }
  PD_HD double total() const {
    double sum = 0;
    for (int lane = 0; lane < block_lanes; ++lane)
      sum += double(part[lane / R::width].v[lane % R::width]);
    return sum;
  }
};
template <class T, int W>
struct LaneSums<Batch<T, W>> {
  using R = Pack<T, W>;
  R part[block_lanes];

  PD_HD void clear() {
    for (R& p : part) p = R(T(0));
  }
  PD_HD Pack<double, W> total() const {
    Pack<double, W> sum(0.0);
    for (const R& p : part) sum = sum + convert<double>(p);
    return sum;
  }
};

// The place of pack number n of a plan, of `parts` packs a block. Groups of elements with Poisson's ratio have one
// lane of `Members` blocks each, one after another; their packs follow one another. 0: elements without.
template <int Members, int parts>
struct PackPlace {
  static constexpr int members = Members > 1 ? Members : 1;
  int block, part;

  PD_HD explicit PackPlace(int n)
      : block(n / members / parts * members + n % members), part(n / members % parts) {}
};

// Weights of the elements of a plan: w V, and V lambda where they have Poisson's ratio; see Workspace.
template <class T>
struct ElementWeights {
  const T *weight, *pressure;
  bool shared;  // by the environments of a batch
};

// Forces of a group's packs until all of them are known; nothing without groups.
template <int Members, class T, int W>
struct GroupForces {
  Quad<T> quads[Members][4][W];
};
template <int Members, class T, int W>
  requires(Members < 2)
struct GroupForces<Members, T, W> {};

// The packs of elements that a functor works on at once, counted by `s`: elements of one environment across lanes.
template <int Fields, class T, int Members = 0>
struct ElementsAcross {
  static constexpr int W = native_width<T>, parts = block_lanes / W, members = Members;
  using R = Pack<T, W>;

  const Plan<T>& plan;
  const Quad<T>* const (&field)[Fields];
  ElementWeights<T> weights;
  Quad<T>* forces;
  LaneSums<Single<T>>& sums;
  int first;  // pack, from the first block of the plan
  [[no_unique_address]] mutable GroupForces<Members, T, W> kept;

  ElementsAcross(const Plan<T>& p, const Quad<T>* const (&f)[Fields], const ElementWeights<T>& w,
                 Quad<T>* g, LaneSums<Single<T>>& all)
      : plan(p), field(f), weights(w), forces(g), sums(all), first(0) {}

  static int packs(int blocks) { return blocks * parts; }
  PD_HD PackPlace<Members, parts> place(int s) const {
    return PackPlace<Members, parts>(first + s);
  }
  PD_HD BlockPart<T> part(int s) const {
    const auto at = place(s);
    return {&plan, at.block, at.part * W};
  }
  PD_HD void corners(int s, int f, Vec3<R> (&x)[4]) const {
    for (int c = 0; c < 4; ++c) x[c] = gather_corner<T, W>(field[f], part(s).corner(c));
  }
  PD_HD FaceRest<R, 1> rest(int s) const {
    return read_rest<R>([&](int number) { return R::load(part(s).rest(number)); });
  }
  PD_HD R weight(int s) const { return R::load(weights.weight + part(s).element()); }
  PD_HD R pressure(int s) const { return R::load(weights.pressure + part(s).element()); }
  PD_HD WholeGroup lanes() const { return {}; }
  PD_HD R& sum(int s) const { return sums.part[place(s).part]; }
  PD_HD void add(int s, const Vec3<R> (&g)[4]) const {
    if constexpr (Members > 1) {
      const int member = s % Members;
      for (int c = 0; c < 4; ++c) store_quads<T, W>(g[c], kept.quads[member][c]);
      if (member == Members - 1) add_group(s - member);
    } else {
      scatter_corners<T, W>(forces, part(s), g);
    }
  }

 private:
  // Group after group, member after member: the order of a batch.
  PD_HD void add_group(int s) const {
    for (int lane = 0; lane < W; ++lane) {
      for (int m = 0; m < Members; ++m) {
        for (int c = 0; c < 4; ++c) {
          Quad<T>& to = forces[part(s + m).corner(c)[lane]];
          to = to + kept.quads[m][c][lane];
        }
      }
    }
  }
};

// The same for one element of W environments across lanes.
template <int Fields, class T, int W, int Members = 0>
struct EnvironmentsAcross {
  static constexpr int members = Members;
  using R = Pack<T, W>;

  const Plan<T>& plan;
  const Vec3<R>* const (&field)[Fields];
  ElementWeights<T> weights;
  Vec3<R>* forces;
  LaneSums<Batch<T, W>>& sums;
  int first;  // element, padding counted

  EnvironmentsAcross(const Plan<T>& p, const Vec3<R>* const (&f)[Fields],
                     const ElementWeights<T>& w, Vec3<R>* g, LaneSums<Batch<T, W>>& all)
      : plan(p), field(f), weights(w), forces(g), sums(all), first(0) {}

  static int packs(int blocks) { return blocks * block_lanes; }
  PD_HD PackPlace<Members, block_lanes> place(int s) const {
    return PackPlace<Members, block_lanes>(first + s);
  }
  PD_HD BlockPart<T> part(int s) const {
    const auto at = place(s);
    return {&plan, at.block, at.part};
  }
  PD_HD void corners(int s, int f, Vec3<R> (&x)[4]) const {
    for (int c = 0; c < 4; ++c) x[c] = field[f][*part(s).corner(c)];
  }
  PD_HD FaceRest<R, 1> rest(int s) const {
    return read_rest<R>([&](int number) { return R(*part(s).rest(number)); });
  }
  PD_HD R weight(int s) const { return load(weights.weight, s); }
  PD_HD R pressure(int s) const { return load(weights.pressure, s); }
  PD_HD R load(const T* from, int s) const {
    const std::int64_t e = part(s).element();
    return weights.shared ? R(from[e]) : R::load(from + e * W);
  }
  PD_HD WholeGroup lanes() const { return {}; }
  PD_HD R& sum(int s) const { return sums.part[place(s).part]; }
  PD_HD void add(int s, const Vec3<R> (&g)[4]) const {
    for (int c = 0; c < 4; ++c) forces[*part(s).corner(c)] = forces[*part(s).corner(c)] + g[c];
  }
};

template <int Fields, class Lanes, int Members>
struct ElementsOf;
template <int Fields, class T, int Members>
struct ElementsOf<Fields, Single<T>, Members> {
  using type = ElementsAcross<Fields, T, Members>;
};
template <int Fields, class T, int W, int Members>
struct ElementsOf<Fields, Batch<T, W>, Members> {
  using type = EnvironmentsAcross<Fields, T, W, Members>;
};

// Calls element.run<N>(elements) on every pack of elements of a patch, Element::strip at a time but whole groups.
template <class T, class Elements, class Element>
PD_HD void each_element(const Plan<T>& plan, int patch, Elements elements, const Element& element) {
  constexpr int least = Elements::members > 1 ? Elements::members : 1;
  constexpr int strip = Element::strip > least ? Element::strip : least;
  const int end = Elements::packs(plan.patch_block[patch + 1]);
  elements.first = Elements::packs(plan.patch_block[patch]);
  for (; elements.first + strip <= end; elements.first += strip) {
    element.template run<strip>(elements);
  }
  for (; elements.first < end; elements.first += least) element.template run<least>(elements);
}

// Calls visit.operator()<Members>() for the members of a group that a plan has; 0: elements without Poisson's ratio.
template <class Visit>
PD_HD void with_members(int members, const Visit& visit) {
  switch (members) {
    case 0:
      return visit.template operator()<0>();
    case 1:
      return visit.template operator()<1>();
    case 2:
      return visit.template operator()<2>();
    default:
      return visit.template operator()<4>();
  }
}

// Wraps a functor of one pack of elements, element(elements, s).
template <class Function>
struct OneByOne {
  static constexpr int strip = 1;
  Function function;

  template <int N, class Elements>
  PD_HD void run(const Elements& elements) const {
    for (int s = 0; s < N; ++s) function(elements, s);
  }
};
template <class Function>
OneByOne<Function> one_by_one(Function function) {
  return {function};
}

}  // namespace pd::inline PD_TARGET
