// What a GPU sums up for the coarse space of solver/multilevel/pieces.h: rows of A and tetrahedra by pairs of pieces.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace pd {

// The items of every pair of pieces, in the order of piece_list, ascending in each. A task is a part of the items of a
// pair: its piece of the row, that of the column, its first item and the end.
struct PairList {
  std::vector<std::int32_t> start;  // [pairs + 1] first task of each pair
  std::vector<std::int32_t> task;   // [tasks, 4]
  std::vector<std::int32_t> item;
};

struct PieceLists {
  PairList
      rows;  // vertices that the first piece moves, with a vertex in their row that the second one moves
  PairList tets;  // tetrahedra with vertices that the one moves, and such of the other
};

// Pieces of each vertex [vertices, pieces_of_vertex], and their weights; the rows of A; corners of tetrahedra [tets, 4].
struct PieceMesh {
  std::int32_t pieces;
  std::span<const std::int32_t> of;
  std::span<const double> weight;
  std::span<const std::int32_t> fine_start, fine_column;
  std::span<const std::int32_t> corners;
};

PieceLists list_pieces(const PieceMesh& mesh);

}  // namespace pd
