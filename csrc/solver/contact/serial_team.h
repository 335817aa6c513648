// The team of solver/contact on one thread: the CPU's, which takes items in order.
#pragma once
#include <cstdint>

namespace pd::inline PD_TARGET {

class SerialTeam {
 public:
  template <class Item>
  void spread(std::int64_t count, const Item& item) const {
    for (std::int64_t i = 0; i < count; ++i) item(int(i));
  }
  template <class Item>
  void each(std::int64_t count, const Item& item) const {
    spread(count, item);
  }
  template <class Start, class Visit>
  void walk(std::int64_t count, const Start& start, const Visit& visit) const {
    for (std::int64_t i = 0; i < count; ++i) {
      auto walk = start(int(i));
      while (!walk.ended) {
        const int other = walk.step();
        if (other >= 0) visit(walk.owner, other);
      }
    }
  }
  template <class Task>
  void once(const Task& task) const {
    task();
  }
  void barrier() const {}

  // Adds what add(i, sums) adds for every item.
  template <int Count, class Add>
  void sum(std::int64_t count, const Add& add, double (&sums)[Count]) const {
    for (std::int64_t i = 0; i < count; ++i) add(int(i), sums);
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

  // calls visit(n, group) for every group; a group has the threads that its sums take
  template <class Visit>
  void groups(int count, const Visit& visit) const {
    for (int n = 0; n < count; ++n) visit(n, *this);
  }
  template <int Count, class Add>
  void sum_range(int begin, int end, const Add& add, double (&sums)[Count]) const {
    for (int i = begin; i < end; ++i) add(i, sums);
  }
  template <int Count, class Take>
  void least_range(int begin, int end, const Take& take, double (&least)[Count]) const {
    for (int i = begin; i < end; ++i) take(i, least);
  }
  // Writes the items of [0, count) that `is` picks to `out`, in their order.
  template <class Is>
  void select(int count, const Is& is, int* out) const {
    for (int i = 0; i < count; ++i)
      if (is(i)) *out++ = i;
  }
  bool leads() const { return true; }
};

}  // namespace pd::inline PD_TARGET
