// Two vectors per slot of a patch in shared memory. The first component of the second vector is
// stored behind the first vector, so that one 16-byte load reads both.
#pragma once
#include "cuda/common/memory.h"
#include "views/shared_memory.h"

#include <cstddef>

namespace pd::inline PD_TARGET {

template <class T>
class Slots {
  struct alignas(2 * sizeof(T)) Two {
    T a, b;
  };

 public:
  Slots() = default;
  // `memory`: slots_bytes for two vectors
  PD_DEVICE Slots(std::byte* memory, int count)
      : first_(reinterpret_cast<Quad<T>*>(memory)),
        behind_(reinterpret_cast<Two*>(first_ + count)) {}

  // The first four of the six components, in one load.
  PD_DEVICE Quad<T> load(unsigned slot_times_8) const { return *at(first_, slot_times_8); }
  // the second vector of a slot that load() has read
  PD_DEVICE Vec3<T> second(unsigned slot_times_8, const Quad<T>& loaded) const {
    const Two two = *at(behind_, slot_times_8);
    return {loaded.w, two.a, two.b};
  }

  // both vectors of a corner's slot, given as in pair_corner; the element kernels call this
  PD_DEVICE void operator()(unsigned corner, Vec3<T> (&vectors)[2]) const {
    const unsigned slot_times_8 = corner & 0xffff;
    const Quad<T> loaded = load(slot_times_8);
    vectors[0] = vec3(loaded);
    vectors[1] = second(slot_times_8, loaded);
  }

  PD_DEVICE void set(int slot, const Vec3<T>& first, const Vec3<T>& second) const {
    first_[slot] = quad(first, second.x);
    behind_[slot] = {second.y, second.z};
  }
  // leaves the second vector unset
  PD_DEVICE void set_first(int slot, const Vec3<T>& first) const { first_[slot] = quad(first); }
  // keeps the first vector
  PD_DEVICE void set_second(int slot, const Vec3<T>& second) const {
    first_[slot].w = second.x;
    behind_[slot] = {second.y, second.z};
  }

 private:
  // takes slots as pair_corner encodes them, which needs the fewest instructions
  template <class Item>
  PD_DEVICE static const Item* at(const Item* array, unsigned slot_times_8) {
    const auto* bytes = reinterpret_cast<const std::byte*>(array);
    return reinterpret_cast<const Item*>(bytes + slot_times_8 * (unsigned(sizeof(Item)) / 8));
  }

  Quad<T>* first_;
  Two* behind_;
};

}  // namespace pd::inline PD_TARGET
