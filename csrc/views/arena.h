// Allocates arrays one after another in a block of memory.
#pragma once
#include "math/device.h"

#include <cstddef>
#include <cstdint>

namespace pd {

// With a null base, the arena only computes the total size.
class Arena {
 public:
  PD_HD explicit Arena(void* base) : base_(static_cast<std::byte*>(base)) {}

  template <class Item>
  PD_HD void place(Item*& array, std::int64_t count) {
    array = reinterpret_cast<Item*>(base_ + size_);
    size_ += (count * std::int64_t(sizeof(Item)) + 255) / 256 * 256;
  }

  PD_HD std::int64_t size() const { return size_; }

 private:
  std::byte* base_;
  std::int64_t size_ = 0;
};

}  // namespace pd
