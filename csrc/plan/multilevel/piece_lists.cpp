#include "plan/multilevel/piece_lists.h"

#include "solver/multilevel/pieces.h"

#include <algorithm>
#include <bit>
#include <numeric>

namespace pd {

namespace {

// Items of a task, one for each lane of a warp at a time, so that there are about so many tasks.
constexpr std::int64_t lanes = 32, least_turns = 4, many_tasks = 4096;

std::vector<PieceMask> masks_of(const PieceMesh& mesh) {
  std::vector<PieceMask> masks(mesh.of.size() / pieces_of_vertex, 0);
  for (std::size_t place = 0; place < mesh.of.size(); ++place) {
    if (mesh.weight[place] > 0) masks[place / pieces_of_vertex] |= PieceMask(1) << mesh.of[place];
  }
  return masks;
}

template <class Visit>
void each_of(PieceMask mask, const Visit& visit) {
  for (; mask; mask &= mask - 1) visit(std::countr_zero(mask));
}

// The list of items 0 ... count - 1: pairs_of(item, add) calls add(row, column) for each of its pairs.
template <class PairsOf>
PairList list_pairs(std::int32_t pieces, std::int64_t count, const PairsOf& pairs_of) {
  const int pairs = piece_pair(pieces, 0);
  std::vector<std::int64_t> start(pairs + 1, 0);
  for (std::int64_t i = 0; i < count; ++i)
    pairs_of(i, [&](int row, int column) { ++start[piece_list(pieces, row, column) + 1]; });
  std::partial_sum(start.begin(), start.end(), start.begin());
  PairList list;
  list.item.resize(start.back());
  std::vector<std::int64_t> next(start.begin(), start.end() - 1);
  for (std::int64_t i = 0; i < count; ++i) {
    pairs_of(i, [&](int row, int column) {
      list.item[next[piece_list(pieces, row, column)]++] = std::int32_t(i);
    });
  }
  const std::int64_t turns = (start.back() + lanes * many_tasks - 1) / (lanes * many_tasks);
  const std::int64_t each = lanes * std::max(turns, least_turns);
  list.start.assign(pairs + 1, 0);
  const auto add_tasks = [&](int row, int column) {
    const int pair = piece_list(pieces, row, column);
    for (std::int64_t first = start[pair]; first < start[pair + 1]; first += each) {
      const std::int64_t end = std::min(first + each, start[pair + 1]);
      for (const std::int64_t number : {std::int64_t(row), std::int64_t(column), first, end})
        list.task.push_back(std::int32_t(number));
    }
    list.start[pair + 1] = std::int32_t(list.task.size() / 4);
  };
  for (int p = 0; p < pieces; ++p) add_tasks(p, p);
  for (int row = 1; row < pieces; ++row) {
    for (int column = 0; column < row; ++column) add_tasks(row, column);
  }
  return list;
}

}  // namespace

PieceLists list_pieces(const PieceMesh& mesh) {
  const std::vector<PieceMask> own = masks_of(mesh);
  // columns not after the row
  const auto add_columns = [](int row, PieceMask columns, const auto& add) {
    const PieceMask later = row == most_pieces - 1 ? 0 : ~PieceMask(0) << (row + 1);
    each_of(columns & ~later, [&](int column) { add(row, column); });
  };
  std::vector<PieceMask> near(own.size(), 0);
  for (std::size_t i = 0; i < own.size(); ++i) {
    for (std::int32_t p = mesh.fine_start[i]; p < mesh.fine_start[i + 1]; ++p)
      near[i] |= own[mesh.fine_column[p]];
  }
  const auto mask_of_tet = [&](std::int64_t tet) {
    PieceMask mask = 0;
    for (const std::int32_t corner : mesh.corners.subspan(4 * tet, 4)) mask |= own[corner];
    return mask;
  };
  return {
      list_pairs(mesh.pieces, std::ssize(own),
                 [&](std::int64_t i, const auto& add) {
                   each_of(own[i], [&](int row) { add_columns(row, near[i], add); });
                 }),
      list_pairs(mesh.pieces, std::ssize(mesh.corners) / 4, [&](std::int64_t tet, const auto& add) {
        const PieceMask mask = mask_of_tet(tet);
        each_of(mask, [&](int row) { add_columns(row, mask, add); });
      })};
}

}  // namespace pd
