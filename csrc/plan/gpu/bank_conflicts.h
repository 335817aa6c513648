// Orders the pairs of a patch, and the entries of their forces, so that a warp seldom meets itself in a bank of shared memory.
#pragma once

#include "plan/gpu/pairing.h"

#include <array>
#include <cstdint>
#include <vector>

namespace pd {

// A warp moves one corner, 16 bytes a lane, in four phases of 8 lanes; a phase takes as many passes as lanes meet in a bank,
// and slots with the same remainder by 8 do, as do their entries. `corner` of the pairs are slots. Changes the order of
// pairs, of the corners of their common face, and of their two tetrahedra.
void spread_banks(std::vector<Pair>& pairs);

// Slots whose entries lie in rows: that of a slot in the next row is so many further.
constexpr int entry_slice = 8;

// In a pipeline (cuda/stream/pipeline.h) entries are numbers of 8 and of 4 bytes. Half a warp moves the former at once, in 16 banks, and
// a warp the latter, in 32. So of the slices that a warp reads in a row, four, each begins in another quarter of the banks, and
// of two neighbours one in either half: `next` is the first such place from `entry` on. Rows left out are 1 in 16.
class SliceBanks {
 public:
  std::int64_t next(std::int64_t entry);

 private:
  int count_ = 0;  // slices so far, of a warp's four
  std::array<bool, 4> taken_ = {};
  int last_ = 0;  // the quarter of the slice before
};

// Which of its entries a slot gives the next pair. `spread`: one whose banks the fewest lanes have written to with the same corner,
// else in the order of pairs. Blocks of 32 lanes come one after another, lanes in order.
class EntryChoice {
 public:
  EntryChoice(const std::vector<std::int32_t>& first, const std::vector<std::int32_t>& forces,
              bool spread);

  std::int32_t take(int corner, int lane, std::int32_t slot);

 private:
  static constexpr int quarters = 4;
  const std::vector<std::int32_t>&first_, &forces_;
  bool spread_;
  // of every slot, the next row not taken of those with each remainder by four; without `spread` the first counts all
  std::vector<std::array<std::int32_t, quarters>> row_;
  // lanes of the block that have written to each bank
  struct Written {
    std::array<std::array<std::uint8_t, 16>, 2> half;
    std::array<std::uint8_t, 32> warp;
  };
  std::array<Written, 5> written_ = {};
};

}  // namespace pd
