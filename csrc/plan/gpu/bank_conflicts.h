// Orders the pairs of a patch, and the entries of their forces, to reduce bank conflicts in a warp's shared memory
// accesses.
#pragma once

#include "plan/gpu/pairing.h"

#include <array>
#include <cstdint>
#include <vector>

namespace pd {

// A warp accesses one corner, 16 bytes a lane, in four phases of 8 lanes. A phase takes as many passes as lanes
// conflict in a bank; slots with the same remainder by 8 conflict, and so do their entries. The corners of `pairs`
// are slots. This changes the order of pairs, of the corners of their common face, and of their two tetrahedra.
void reduce_bank_conflicts(std::vector<Pair>& pairs);

// The same where the first `coupled` pairs stay two by two, in front.
void reduce_bank_conflicts(std::vector<Pair>& pairs, std::int64_t coupled);

// Slots per slice; the entries of a slot lie so many places apart.
constexpr int entry_slice = 8;

// Entries of a pipeline (cuda/stream/pipeline.h) are numbers of 8 and of 4 bytes. Half a warp accesses the former at once,
// in 16 banks, and a warp the latter, in 32. So each of the four slices that a warp reads in a row begins in another
// quarter of the banks, and neighbours begin in different halves. `next` is the first such place from `entry` on. It
// leaves out 1 row in 16.
class SliceBanks {
 public:
  std::int64_t next(std::int64_t entry);

 private:
  int count_ = 0;  // slices so far, of a warp's four
  std::array<bool, 4> taken_ = {};
  int last_ = 0;  // the quarter of the previous slice
};

// Chooses the entry that a slot gives to the next pair. With `spread` its bank is the one that the fewest lanes have
// written with the same corner; else entries follow the order of pairs. Blocks of 32 lanes come in turn, lanes in
// order.
class EntryChoice {
 public:
  EntryChoice(const std::vector<std::int32_t>& first, const std::vector<std::int32_t>& forces,
              bool spread);

  std::int32_t take(int corner, int lane, std::int32_t slot);

 private:
  static constexpr int quarters = 4;
  const std::vector<std::int32_t>&first_, &forces_;
  bool spread_;
  // for every slot, the next free row for each remainder by four; without `spread` the first counts all
  std::vector<std::array<std::int32_t, quarters>> row_;
  // lanes of the block that have written to each bank, and the most of them
  struct Written {
    std::array<std::array<std::uint8_t, 16>, 2> half;
    std::array<std::uint8_t, 32> warp;
    std::array<std::uint8_t, 2> most_half;
    std::uint8_t most_warp;
  };
  std::array<Written, 5> written_ = {};
};

}  // namespace pd
