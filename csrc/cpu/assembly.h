// Element work of one patch: corners in, forces on the slots of the patch out, in a fixed order.
#pragma once
#include "cpu/lanes.h"

namespace pd::inline PD_TARGET {

// The lanes of one block of elements that a pack holds.
template <class T>
struct BlockPart {
  const Plan<T>* plan;
  int block, first_lane;

  PD_HD const int16* corner(int c) const {
    return plan->tet_corner + (std::int64_t(block) * 4 + c) * block_lanes + first_lane;
  }
  PD_HD const T* rest(int entry) const {
    return plan->tet_rest + (std::int64_t(block) * 9 + entry) * block_lanes + first_lane;
  }
  PD_HD std::int64_t element() const { return std::int64_t(block) * block_lanes + first_lane; }
};

template <class R, class Read>
PD_HD Mat3<R> read_matrix(Read read) {
  return {{{read(0), read(1), read(2)}, {read(3), read(4), read(5)}, {read(6), read(7), read(8)}}};
}

// Corner of W elements, from vertices stored as quads.
template <class T, int W>
PD_HD Vec3<Pack<T, W>> gather_corner(const Quad<T>* x, const int16* slot) {
#if PD_VECTOR_BYTES == 64
  if constexpr (W == 16 && sizeof(T) == 4) {
    const float* from = reinterpret_cast<const float*>(x);
    const __m512i offset =
        _mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)slot)), 2);
    using V = typename Pack<T, W>::Vector;
    return {V(_mm512_i32gather_ps(offset, from, 4)), V(_mm512_i32gather_ps(offset, from + 1, 4)),
            V(_mm512_i32gather_ps(offset, from + 2, 4))};
  }
  if constexpr (W == 8 && sizeof(T) == 8) {
    const double* from = reinterpret_cast<const double*>(x);
    const __m256i offset =
        _mm256_slli_epi32(_mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i*)slot)), 2);
    using V = typename Pack<T, W>::Vector;
    return {V(_mm512_i32gather_pd(offset, from, 8)), V(_mm512_i32gather_pd(offset, from + 1, 8)),
            V(_mm512_i32gather_pd(offset, from + 2, 8))};
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
#endif
  for (int lane = 0; lane < W; ++lane)
    quads[lane] = to_quad(T(a.x.v[lane]), T(a.y.v[lane]), T(a.z.v[lane]));
}

// Adds element after element, corner after corner: the order in which a batch does it.
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

// element(corners of each field, rest_inverse, weight, force, position in the block), for every pack of elements of a patch.
template <int Fields, class T, class Element>
PD_HD void each_element(Single<T>, const Plan<T>& plan, int patch,
                        const Quad<T>* const (&field)[Fields], const T* weight, bool, Quad<T>* g,
                        Element element) {
  constexpr int W = native_width<T>;
  using R = Pack<T, W>;
  for (int block = plan.patch_block[patch]; block < plan.patch_block[patch + 1]; ++block) {
    for (int first = 0; first < block_lanes; first += W) {
      const BlockPart<T> part = {&plan, block, first};
      Vec3<R> corner[Fields][4], force[4];
      for (int f = 0; f < Fields; ++f) {
        for (int c = 0; c < 4; ++c) corner[f][c] = gather_corner<T, W>(field[f], part.corner(c));
      }
      const Mat3<R> rest = read_matrix<R>([&](int entry) { return R::load(part.rest(entry)); });
      element(corner, rest, R::load(weight + part.element()), force, first / W);
      scatter_corners<T, W>(g, part, force);
    }
  }
}

template <int Fields, class T, int W, class Element>
PD_HD void each_element(Batch<T, W>, const Plan<T>& plan, int patch,
                        const Vec3<Pack<T, W>>* const (&field)[Fields], const T* weight,
                        bool shared_weight, Vec3<Pack<T, W>>* g, Element element) {
  using R = Pack<T, W>;
  for (int block = plan.patch_block[patch]; block < plan.patch_block[patch + 1]; ++block) {
    for (int lane = 0; lane < block_lanes; ++lane) {
      const BlockPart<T> part = {&plan, block, lane};
      if (plan.tet_volume[part.element()] == T(0)) continue;
      Vec3<R> corner[Fields][4], force[4];
      for (int f = 0; f < Fields; ++f) {
        for (int c = 0; c < 4; ++c) corner[f][c] = field[f][*part.corner(c)];
      }
      const Mat3<R> rest = read_matrix<R>([&](int entry) { return R(*part.rest(entry)); });
      const R w = shared_weight ? R(weight[part.element()]) : R::load(weight + part.element() * W);
      element(corner, rest, w, force, lane);
      for (int c = 0; c < 4; ++c) g[*part.corner(c)] = g[*part.corner(c)] + force[c];
    }
  }
}

// Numbers that each_element's `position` counts: one a lane of the block, whichever way lanes run.
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

}  // namespace pd::inline PD_TARGET
