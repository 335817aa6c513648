// L^-T (L^-1 r), symmetric and positive in any precision: the coarse solve of v_cycle.h. L^-1 is stored row by row up
// to the diagonal.
//
// One environment and several get the same bits. Number j of a row goes to chain j mod 4, and chains are added up
// last; a column is one chain. Rows and columns differ in length, so threads take them in turn.
#pragma once
#include "cpu/step/lanes.h"
#include "solver/multilevel/lbfgs.h"
#include "threads/team.h"

#include <algorithm>
#include <cstdint>
#include <cstring>

namespace pd::inline PD_TARGET {

template <class Lanes>
class Dense {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  static constexpr bool alone = Lanes::environments == 1;

  // for one environment: numbers of a vector, quads in it, and columns that a thread works on at once
  static constexpr int width = std::max(native_width<T>, 4), quads = width / 4;
  static constexpr int strip = alone ? 2 * width : 8;
  using Wide = Pack<T, width>;

 public:
  Dense(const T* factor, int size) : factor_(factor), size_(size) {}

  // out = L^-T half, half = L^-1 in
  void solve(const Team& team, const Value* in, Value* half, Value* out) const {
    constexpr int rows = alone ? row_chains : 1;
    for (int i = team.rank * rows; i < size_; i += team.size * rows) {
      if constexpr (alone) {
        four_rows(i, in, half);
      } else {
        Value sum[row_chains] = {};
        half[i] = finish_row(i, 0, in, sum);
      }
    }
    team.barrier();
    for (int first = team.rank * strip; first < size_; first += team.size * strip)
      some_columns(first, half, out);
    team.barrier();
  }

 private:
  const T* row(std::int64_t i) const { return factor_ + i * (i + 1) / 2; }

  // the numbers of row i from `begin` on, a multiple of row_chains
  Value finish_row(int i, int begin, const Value* x, Value (&sum)[row_chains]) const {
    const T* numbers = row(i);
    int j = begin;
    for (; j + row_chains <= i + 1; j += row_chains) {
      for (int c = 0; c < row_chains; ++c)
        sum[c] = multiply_add(Real(numbers[j + c]), x[j + c], sum[c]);
    }
    for (int c = 0; j + c <= i; ++c) sum[c] = multiply_add(Real(numbers[j + c]), x[j + c], sum[c]);
    return sum_chains(sum);
  }

  // Rows i ... i + 3, i a multiple of four. Up to number i a vector holds the chains of a row side by side.
  void four_rows(int i, const Value* x, Value* out) const {
    constexpr int vectors = row_chains / quads;
    const int count = std::min(row_chains, size_ - i);
    const T* numbers[row_chains];
    for (int r = 0; r < row_chains; ++r) numbers[r] = row(i + std::min(r, count - 1));
    Wide sum[row_chains][vectors];
    for (auto& of_row : sum) std::fill_n(of_row, vectors, Wide(T(0)));
    for (int j = 0; j < i; j += row_chains) {
      for (int v = 0; v < vectors; ++v) {
        const Wide at = Wide::load(reinterpret_cast<const T*>(x + j + v * quads));
        for (int r = 0; r < row_chains; ++r)
          sum[r][v] = multiply_add(four_times(numbers[r] + j + v * quads), at, sum[r][v]);
      }
    }
    for (int r = 0; r < count; ++r) {
      Value chains[row_chains];
      static_assert(sizeof(chains) == sizeof(sum[r]));
      std::memcpy(chains, sum[r], sizeof(chains));
      out[i + r] = finish_row(i + r, i, x, chains);
    }
  }

  // Columns from `first` on. One environment handles the rows below their first triangle axis by axis.
  void some_columns(int first, const Value* x, Value* out) const {
    const int columns = std::min(strip, size_ - first), end = first + columns;
    Value sum[strip] = {};
    const auto add = [&](int i, int filled) {
      const T* numbers = row(i) + first;
      for (int j = 0; j < filled; ++j) sum[j] = multiply_add(Real(numbers[j]), x[i], sum[j]);
    };
    for (int i = first; i < end; ++i) add(i, i - first + 1);
    if constexpr (alone) {
      if (end < size_) add_below(first, x, sum);
    } else {
      for (int i = end; i < size_; ++i) add(i, strip);
    }
    std::copy_n(sum, columns, out + first);
  }

  void add_below(int first, const Value* x, Value (&sum)[strip]) const {
    constexpr int parts = strip / width;
    T number[3][strip];
    Wide axis[3][parts];
    for (int c = 0; c < 3; ++c) {
      for (int j = 0; j < strip; ++j) number[c][j] = sum[j].q.v[c];
      for (int p = 0; p < parts; ++p) axis[c][p] = Wide::load(number[c] + p * width);
    }
    for (int i = first + strip; i < size_; ++i) {
      const T* numbers = row(i) + first;
      for (int p = 0; p < parts; ++p) {
        const Wide these = Wide::load(numbers + p * width);
        for (int c = 0; c < 3; ++c)
          axis[c][p] = multiply_add(these, Wide(T(x[i].q.v[c])), axis[c][p]);
      }
    }
    static_assert(sizeof(number) == sizeof(axis));
    std::memcpy(number, axis, sizeof(axis));
    for (int j = 0; j < strip; ++j) sum[j] = to_quad(number[0][j], number[1][j], number[2][j]);
  }

  // each of the next numbers, repeated in a quad of its own
  static Wide four_times(const T* numbers) {
    using V [[maybe_unused]] = typename Wide::Vector;
#if PD_VECTOR_BYTES == 64
    if constexpr (sizeof(T) == 4) {
      const __m512i lane = _mm512_set_epi32(3, 3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0);
      return V(_mm512_permutexvar_ps(lane, _mm512_castps128_ps512(_mm_loadu_ps(numbers))));
    } else {
      return V(_mm512_insertf64x4(_mm512_castpd256_pd512(_mm256_broadcast_sd(numbers)),
                                  _mm256_broadcast_sd(numbers + 1), 1));
    }
#elif PD_VECTOR_BYTES == 32
    if constexpr (sizeof(T) == 4) {
      return V(_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_broadcast_ss(numbers)),
                                    _mm_broadcast_ss(numbers + 1), 1));
    }
#endif
    Wide result;
    for (int l = 0; l < width; ++l) result.v[l] = numbers[l / 4];
    return result;
  }

  const T* factor_;
  int size_;
};

}  // namespace pd::inline PD_TARGET
