// Two vectors of every slot of a patch in shared memory, six numbers a slot: the second's first number lies behind the first
// vector, where 16-byte loads bring it along.
#pragma once
#include "cuda/memory.h"
#include "plan/shared_memory.h"

#include <cstddef>

namespace pd::inline PD_TARGET {

template <class T>
class Slots {
  struct alignas(2 * sizeof(T)) Two {
    T a, b;
  };

 public:
  Slots() = default;
  // `memory`: slots_bytes of two vectors
  PD_DEVICE Slots(std::byte* memory, int count)
      : first_(reinterpret_cast<Quad<T>*>(memory)),
        behind_(reinterpret_cast<Two*>(first_ + count)) {}

  // as much of a slot as one load brings
  PD_DEVICE Quad<T> look(int slot) const { return first_[slot]; }
  // the second vector of a slot that was looked at
  PD_DEVICE Vec3<T> second(int slot, const Quad<T>& seen) const {
    return {seen.w, behind_[slot].a, behind_[slot].b};
  }

  PD_DEVICE void set(int slot, const Vec3<T>& first, const Vec3<T>& second) const {
    first_[slot] = quad(first, second.x);
    behind_[slot] = {second.y, second.z};
  }
  // the second vector stays
  PD_DEVICE void set_first(int slot, const Vec3<T>& first) const {
    const Two two = {first.x, first.y};
    __builtin_memcpy(first_ + slot, &two, sizeof(two));
    first_[slot].z = first.z;
  }

 private:
  Quad<T>* first_;
  Two* behind_;
};

}  // namespace pd::inline PD_TARGET
