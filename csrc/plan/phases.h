// Orders the pairs of a patch so that a warp seldom meets itself in a bank of shared memory.
#pragma once

#include "plan/pairing.h"

namespace pd {

// A warp moves one corner, 16 bytes a lane, in four phases of 8 lanes; a phase takes as many passes as lanes meet in a bank,
// and slots with the same remainder by 8 do, as do their entries. `corner` of the pairs are slots. Changes the order of
// pairs, of the corners of their common face, and of their two tetrahedra.
void spread_banks(std::vector<Pair>& pairs);

}  // namespace pd
