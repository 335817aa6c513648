// The team of solver/adjoint's pairs on one thread. cuda/adjoint/pair_team.cuh has that of blocks.
//
// A team splits loops and waits after each. Its sums do not depend on the number of its threads.
#pragma once
#include "math/device.h"

#include <cstdint>
#include <type_traits>

namespace pd::inline PD_TARGET {

// The largest of some numbers, and the first that has it.
struct Largest {
  double value;
  int index;
};

// Of two arrays.
struct DotProduct {
  const double *a, *b;
  int length;
};

class OneThread {
 public:
  template <class Item>
  void each(std::int64_t count, const Item& item) const {
    for (std::int64_t i = 0; i < count; ++i) item(int(i));
  }
  // item(first, width): some numbers from `first` on, as many as are good to take together
  template <class Item>
  void strips(int count, const Item& item) const {
    int i = 0;
    for (; i + 32 <= count; i += 32) item(i, std::integral_constant<int, 32>());
    for (; i + 4 <= count; i += 4) item(i, std::integral_constant<int, 4>());
    for (; i < count; ++i) item(i, std::integral_constant<int, 1>());
  }
  template <class Item>
  void grid(int rows, int columns, const Item& item) const {
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < columns; ++j) item(i, j);
  }
  // take(n, the product of(n))
  template <class Of, class Take>
  void dots(std::int64_t count, const Of& of, const Take& take) const {
    constexpr int width = 8;
    for (int n = 0; n < int(count); ++n) {
      const DotProduct product = of(n);
      const double *a = product.a, *b = product.b;
      double sums[width] = {}, sum = 0;
      int left = product.length;
      for (; left >= width; left -= width, a += width, b += width)
        for (int u = 0; u < width; ++u) sums[u] += a[u] * b[u];
      for (int u = 0; u < left; ++u) sum += a[u] * b[u];
      for (double part : sums) sum += part;
      take(n, sum);
    }
  }
  // take(n, sum of term(n, p) over p below length)
  template <class Term, class Take>
  void sums(std::int64_t count, int length, const Term& term, const Take& take) const {
    for (int n = 0; n < int(count); ++n) {
      double sum = 0;
      for (int p = 0; p < length; ++p) sum += term(n, p);
      take(n, sum);
    }
  }
  // of value(i), or {least, -1} if none is larger
  template <class Value>
  Largest largest(int count, double least, const Value& value) const {
    Largest found{least, -1};
    for (int i = 0; i < count; ++i) {
      const double own = value(i);
      if (own > found.value) found = {own, i};
    }
    return found;
  }
  // Replaces numbers [count] by the sums of those before; [count] is the sum of all.
  void scan(int* numbers, std::int64_t count) const {
    int sum = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      const int own = numbers[i];
      numbers[i] = sum;
      sum += own;
    }
    numbers[count] = sum;
  }
  template <class Task>
  void once(const Task& task) const {
    task();
  }
  void barrier() const {}
  // Adds to a number that other threads may add to; returns what it was.
  int add(int* to, int more) const {
    const int was = *to;
    *to += more;
    return was;
  }
};

}  // namespace pd::inline PD_TARGET
