#include "plan/gpu/rows.h"

#include "plan/gpu/bank_conflicts.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

namespace pd {

namespace {

// places of the corners a and b in a term, 5 a + b, and of its stencil
constexpr std::int64_t term_corners = 5, term_step = 32, most_stencils = std::int64_t(1) << 26;

struct Term {
  std::int32_t slot, neighbour, packed;

  bool is_of(const Term& other) const { return slot == other.slot && neighbour == other.neighbour; }
};

double product(const StencilGroup& group, std::int64_t s, int a, int b) {
  const double* g = group.gradient + s * group.corners * group.dims;
  double sum = 0;
  for (int j = 0; j < group.dims; ++j) sum += g[a * group.dims + j] * g[b * group.dims + j];
  return sum;
}

// The terms of the stencils of a kind, which begin in block `block` of the patch: those between two vertices, and with
// the vertex itself those of the diagonal.
void add_terms(const PatchStencils& own, const StencilGroup& group, std::int64_t block,
               std::vector<Term>& terms) {
  for (std::int64_t i = 0; i < std::ssize(own.number); ++i) {
    const std::int32_t* slot = &own.corner[i * group.corners];
    const auto packed = [&](int a, int b) {
      return std::int32_t((block * lanes + i) * term_step + term_corners * a + b);
    };
    for (int a = 0; a < group.corners; ++a) {
      for (int b = 0; b < group.corners; ++b) {
        if (product(group, own.number[i], a, b) == 0 || (a != b && slot[a] == slot[b])) continue;
        terms.push_back({slot[a], slot[b], packed(a, b)});
      }
    }
  }
}

// A row of the matrix: runs of terms, one for each neighbour, and that of the diagonal.
struct Row {
  std::int32_t slot;
  std::vector<std::pair<std::size_t, std::size_t>> neighbours;
  std::pair<std::size_t, std::size_t> diagonal = {0, 0};
};

std::vector<Row> rows_of(const std::vector<Term>& terms) {
  std::vector<Row> rows;
  for (std::size_t begin = 0, end = 0; begin < terms.size(); begin = end) {
    while (end < terms.size() && terms[end].is_of(terms[begin])) ++end;
    const Term& term = terms[begin];
    if (rows.empty() || rows.back().slot != term.slot) rows.push_back({term.slot, {}});
    if (term.slot == term.neighbour) {
      rows.back().diagonal = {begin, end};
    } else {
      rows.back().neighbours.emplace_back(begin, end);
    }
  }
  // rows of a block are about as long
  std::stable_sort(rows.begin(), rows.end(), [](const Row& a, const Row& b) {
    return a.neighbours.size() > b.neighbours.size();
  });
  return rows;
}

// Appends a run of terms as one number of the rows.
void add_number(const std::vector<Term>& terms, std::pair<std::size_t, std::size_t> run,
                std::vector<std::int32_t>& count, std::vector<std::int32_t>& packed) {
  count.push_back(std::int32_t(run.second - run.first));
  for (std::size_t t = run.first; t < run.second; ++t) packed.push_back(terms[t].packed);
}

std::int32_t both(std::int64_t first, std::int64_t second) {
  return std::int32_t(std::uint32_t(slot_step * first) | std::uint32_t(slot_step * second) << 16);
}

// 32 rows, from `first` on.
void add_block(PatchRows& to, const std::vector<Row>& rows, std::size_t first,
               const std::vector<Term>& terms) {
  const Row none_at_all{rows[first].slot, {}};
  const auto row = [&](int lane) -> const Row& {
    return first + lane < rows.size() ? rows[first + lane] : none_at_all;
  };
  const std::size_t width = (rows[first].neighbours.size() + 1) / 2;
  for (std::size_t k = 0; k < width; ++k) {
    for (int lane = 0; lane < lanes; ++lane) {
      const Row& of = row(lane);
      std::array<std::int64_t, 2> neighbour;
      for (std::size_t side = 0; side < 2; ++side) {
        const bool there = 2 * k + side < of.neighbours.size();
        const auto run =
            there ? of.neighbours[2 * k + side] : std::pair<std::size_t, std::size_t>{};
        neighbour[side] = there ? terms[run.first].neighbour : of.slot;
        add_number(terms, run, to.count, to.term);
      }
      to.neighbour.push_back(both(neighbour[0], neighbour[1]));
    }
  }
  for (int lane = 0; lane < lanes; ++lane) {
    const Row& of = row(lane);
    to.slot.push_back(first + lane < rows.size() ? of.slot : -1);
    add_number(terms, of.diagonal, to.diagonal_count, to.diagonal_term);
  }
  to.width.push_back(std::int32_t(width));
}

// The first slot of a block, which its padding repeats.
std::int32_t slot_in(const PatchRows& rows, std::int64_t place) {
  return rows.slot[place] >= 0 ? rows.slot[place] : rows.slot[place / lanes * lanes];
}

void check_stencils(const DeviceMeshPlan& plan, std::size_t patches) {
  const std::int64_t stencils = std::ssize(plan.stencil_order);
  if (stencils < most_stencils) return;
  throw std::overflow_error("patches = " + std::to_string(patches) + ": they would have " +
                            std::to_string(stencils) +
                            " stencils, padding included, and terms of " + "32 bits count up to " +
                            std::to_string(most_stencils) + "; take a coarser mesh");
}

}  // namespace

bool has_rows(const MeshElements& elements) {
  return std::any_of(elements.groups.begin(), elements.groups.end(),
                     [](const StencilGroup& group) { return group.quadratic; });
}

void make_rows(MeshPatch& patch, const MeshElements& elements) {
  const auto is_quadratic = [&](const PatchStencils& own) {
    return elements.groups[own.group].quadratic;
  };
  std::vector<Term> terms;
  std::int64_t block = 0;
  for (const PatchStencils& own : patch.stencils) {
    if (is_quadratic(own)) add_terms(own, elements.groups[own.group], block, terms);
    block += own.blocks();
  }
  std::stable_sort(terms.begin(), terms.end(), [](const Term& a, const Term& b) {
    return std::tie(a.slot, a.neighbour) < std::tie(b.slot, b.neighbour);
  });
  const std::vector<Row> rows = rows_of(terms);
  for (std::size_t first = 0; first < rows.size(); first += lanes)
    add_block(patch.rows, rows, first, terms);

  std::vector<std::int32_t>& forces = patch.step.forces;
  forces.assign(patch.vertex.size(), 0);
  for (const Pair& pair : patch.pairs) {
    for (int c = 0; c < pair.corners(); ++c) ++forces[pair.corner[c]];
  }
  for (const PatchStencils& own : patch.stencils) {
    if (is_quadratic(own)) continue;
    for (const std::int32_t corner : own.corner) ++forces[corner];
  }
  for (const Row& row : rows) ++forces[row.slot];
  patch.step.place(false);
}

void number_rows(DeviceMeshPlan& plan, const MeshElements& elements,
                 const std::vector<MeshPatch>& patches) {
  if (elements.groups.empty()) return;
  plan.row_sizes.assign(row_size_count, 0);
  if (!has_rows(elements)) return;
  check_stencils(plan, patches.size());
  plan.patch_row = plan.row_start = plan.term_start = {0};
  std::int64_t slots = 0, terms = 0;
  std::int32_t entries = 0, outside = 0;
  for (std::size_t p = 0; p < patches.size(); ++p) {
    const PatchRows& rows = patches[p].rows;
    for (const std::int32_t width : rows.width)
      plan.row_start.push_back(plan.row_start.back() + width);
    plan.patch_row.push_back(plan.patch_row.back() + std::int32_t(rows.width.size()));
    std::int32_t end = plan.patch_stencil[p];
    for (const PatchStencils& own : patches[p].stencils)
      end += elements.groups[own.group].quadratic ? 0 : std::int32_t(own.blocks());
    plan.patch_element.push_back(end);
    outside += end - plan.patch_stencil[p];
    slots += std::ssize(patches[p].vertex);
    terms += std::ssize(rows.term) + std::ssize(rows.diagonal_term);
    entries = std::max(entries, std::int32_t(patches[p].step.entries));
  }
  if (terms >= std::int64_t(1) << 31)
    throw std::overflow_error("patches = " + std::to_string(patches.size()) +
                              ": their rows would have " + std::to_string(terms) +
                              " terms, and 32 bits count them; take a coarser mesh");
  // terms of the neighbours of all patches, then of all diagonals
  plan.row_term.reserve(terms);
  const auto append = [&](const auto& counts, const auto& packed) {
    for (std::size_t p = 0; p < patches.size(); ++p) {
      const std::int32_t base = plan.patch_stencil[p] * std::int32_t(lanes * term_step);
      for (const std::int32_t count : patches[p].rows.*counts)
        plan.term_start.push_back(plan.term_start.back() + count);
      for (const std::int32_t term : patches[p].rows.*packed) plan.row_term.push_back(base + term);
    }
  };
  append(&PatchRows::count, &PatchRows::term);
  append(&PatchRows::diagonal_count, &PatchRows::diagonal_term);

  const std::size_t blocks = plan.patch_row.back(), rows = plan.row_start.back();
  plan.row_corner.resize(blocks * lanes);
  plan.row_neighbour.resize(rows * lanes);
  plan.step_row.resize(slots);
  plan.step_pair_corner.resize(plan.pair_corner.size());
  plan.step_corner.resize(plan.stencil_corner.size());
  plan.row_sizes[row_lines] = std::int32_t(rows);
  plan.row_sizes[row_blocks] = std::int32_t(blocks);
  plan.row_sizes[row_terms] = std::int32_t(terms);
  plan.row_sizes[row_slots] = std::int32_t(slots);
  plan.row_sizes[row_pair_blocks] = plan.patch_block.back();
  plan.row_sizes[row_corner_rows] = plan.stencil_sizes[stencil_corner_rows];
  plan.row_sizes[row_step_entries] = entries;
  plan.row_sizes[row_step_stencils] = outside;
  for (const StencilGroup& group : elements.groups)
    plan.row_sizes[row_kinds] |= std::int32_t(group.quadratic) << group.kind;
}

void fill_rows(DeviceMeshPlan& plan, const MeshElements& elements, const MeshPatch& patch,
               int number) {
  if (plan.patch_row.empty()) return;
  EntryChoice choice(patch.step.first, patch.step.forces, false);
  const auto corner = [](std::int64_t slot, std::int64_t entry) {
    return std::int32_t(std::uint32_t(slot_step * slot) | std::uint32_t(entry) << 16);
  };
  // as fill_blocks and fill_stencils place them
  const std::int64_t first_pairs = plan.patch_block[number], count = std::ssize(patch.pairs);
  for (std::int64_t i = 0; i < patch.blocks() * lanes; ++i) {
    const Pair& pair = patch.pairs[std::min(i, count - 1)];
    const int forces = i < count ? pair.corners() : 0, lane = int(i % lanes);
    for (int c = 0; c < 5; ++c)
      plan.step_pair_corner[(5 * (first_pairs + i / lanes) + c) * lanes + lane] =
          corner(pair.corner[c], c < forces ? choice.take(c, lane, pair.corner[c]) : none);
  }
  std::int64_t block = plan.patch_stencil[number];
  for (const PatchStencils& own : patch.stencils) {
    const StencilGroup& group = elements.groups[own.group];
    const std::int64_t stencils = std::ssize(own.number);
    for (std::int64_t i = 0; i < own.blocks() * lanes; ++i) {
      const std::int64_t first = plan.stencil_block[4 * (block + i / lanes) + 1];
      const std::int32_t* slot = &own.corner[std::min(i, stencils - 1) * group.corners];
      const bool takes = i < stencils && !group.quadratic;
      for (int c = 0; c < group.corners; ++c)
        plan.step_corner[(first + c) * lanes + i % lanes] =
            corner(slot[c], takes ? choice.take(c, int(i % lanes), slot[c]) : none);
    }
    block += own.blocks();
  }
  const PatchRows& rows = patch.rows;
  const std::int64_t first_row = std::int64_t(plan.patch_row[number]);
  for (std::int64_t i = 0; i < std::ssize(rows.slot); ++i) {
    const std::int32_t slot = slot_in(rows, i);
    plan.row_corner[first_row * lanes + i] =
        corner(slot, rows.slot[i] >= 0 ? choice.take(0, int(i % lanes), slot) : none);
  }
  std::copy(rows.neighbour.begin(), rows.neighbour.end(),
            plan.row_neighbour.begin() + std::ptrdiff_t(plan.row_start[first_row]) * lanes);
  for (std::size_t s = 0; s < patch.vertex.size(); ++s)
    plan.step_row[plan.patch_slot[number] + s] = std::int32_t(
        std::uint32_t(patch.step.first[s]) | std::uint32_t(patch.step.forces[s]) << 16);
}

}  // namespace pd
