// Memory of solver/adjoint's pairs, of one environment at a time.
#pragma once
#include "solver/adjoint/pairs.h"
#include "views/arena.h"

#include <cstddef>
#include <memory>

namespace pd::inline PD_TARGET {

template <class T>
class PairStorage {
 public:
  explicit PairStorage(const LoadedPairs<T>& call) : call_(call) {}

  // For the pairs of an environment. It stays until the next call.
  const PairMemory& memory(std::int64_t environment) {
    PairSizes sizes = pair_sizes(call_);
    sizes.pairs = 0;
    for (int n = 0; n < call_.plan.capacity; ++n) {
      const std::int64_t row = environment * call_.plan.capacity + n;
      sizes.pairs += call_.keys[row] >= 0 && call_.forces[4 * row] > T(0);
    }
    arrays_.arrange(memory_, sizes);
    return memory_;
  }

  PairFactors factors(std::int64_t low, std::int64_t square) {
    PairFactors factors;
    numbers_.arrange(factors, low, square);
    return factors;
  }

 private:
  // Grows, and leaves the pages of large memory untouched.
  class Block {
   public:
    template <class Arrays, class... Sizes>
    void arrange(Arrays& arrays, const Sizes&... sizes) {
      Arena count(nullptr);
      arrays.arrange(count, sizes...);
      if (count.size() > size_) {
        size_ = count.size();
        bytes_ = std::make_unique_for_overwrite<std::byte[]>(std::size_t(size_));
      }
      Arena arena(bytes_.get());
      arrays.arrange(arena, sizes...);
    }

   private:
    std::int64_t size_ = 0;
    std::unique_ptr<std::byte[]> bytes_;
  };

  const LoadedPairs<T>& call_;
  Block arrays_, numbers_;
  PairMemory memory_;
};

}  // namespace pd::inline PD_TARGET
