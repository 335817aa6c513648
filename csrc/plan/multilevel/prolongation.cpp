#include "plan/multilevel/prolongation.h"

#include "solver/multilevel/lbfgs.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <utility>

namespace pd {

namespace {

constexpr double dependent = 1e-8;  // orthogonalisation leaves less of a dependent column

// Orthonormalises the four columns of q [rows, 4]; a dependent column becomes zero. Returns R of the factorisation q
// R.
std::array<double, 16> orthonormalise(std::vector<double>& q) {
  std::array<double, 16> r{};
  const std::size_t rows = q.size() / node_functions;
  const auto dot = [&](int a, int b) {
    double sum = 0;
    for (std::size_t i = 0; i < rows; ++i)
      sum += q[i * node_functions + a] * q[i * node_functions + b];
    return sum;
  };
  for (int c = 0; c < node_functions; ++c) {
    const double before = std::sqrt(dot(c, c));
    // twice is enough (Kahan and Parlett)
    for (int pass = 0; pass < 2; ++pass) {
      for (int k = 0; k < c; ++k) {
        const double part = dot(k, c);
        r[k * node_functions + c] += part;
        for (std::size_t i = 0; i < rows; ++i)
          q[i * node_functions + c] -= part * q[i * node_functions + k];
      }
    }
    const double left = std::sqrt(dot(c, c)), scale = left > dependent * before ? 1 / left : 0;
    r[c * node_functions + c] = scale > 0 ? left : 0;
    for (std::size_t i = 0; i < rows; ++i) q[i * node_functions + c] *= scale;
  }
  return r;
}

// (I - omega D^-1 A) P
BlockMatrix smoothed(const BlockMatrix& a, const std::vector<double>& inverse, double omega,
                     const BlockMatrix& p, int threads) {
  BlockMatrix prolongation = multiply(a, p, threads);
  const std::int64_t block = prolongation.block();
  for_rows(prolongation.rows, threads, [&](std::int64_t row) {
    for (std::int32_t e = prolongation.start[row]; e < prolongation.start[row + 1]; ++e) {
      const bool own =
          p.start[row] < p.start[row + 1] && p.column[p.start[row]] == prolongation.column[e];
      for (std::int64_t k = 0; k < block; ++k) {
        const double scale = omega * inverse[row * prolongation.height + k / node_functions];
        const double kept = own ? p.value[p.start[row] * block + k] : 0;
        prolongation.value[e * block + k] = kept - scale * prolongation.value[e * block + k];
      }
    }
  });
  return prolongation;
}

// row of m *= factor scale
void scale_row(BlockMatrix& m, std::int64_t row, double factor, const std::vector<double>& scale) {
  for (std::int32_t e = m.start[row]; e < m.start[row + 1]; ++e) {
    for (std::int64_t k = 0; k < m.block(); ++k)
      m.value[e * m.block() + k] *= factor * scale[row * m.height + k / m.width];
  }
}

// row of sum += row of m, where `sum` has all blocks of m
void add_row(BlockMatrix& sum, const BlockMatrix& m, std::int64_t row) {
  std::int32_t to = sum.start[row];
  for (std::int32_t e = m.start[row]; e < m.start[row + 1]; ++e) {
    while (to < sum.start[row + 1] && sum.column[to] != m.column[e]) ++to;
    if (to == sum.start[row + 1]) throw std::logic_error("a matrix level lacks its diagonal");
    for (std::int64_t k = 0; k < m.block(); ++k)
      sum.value[to * m.block() + k] += m.value[e * m.block() + k];
  }
}

}  // namespace

Tentative tentative(const std::vector<double>& candidates, int height, const Aggregates& groups,
                    int threads) {
  const std::int32_t rows = std::int32_t(groups.of.size());
  const int block = height * node_functions;
  Tentative t{{height, node_functions, rows, groups.count, {0}, {}, {}}, {}};
  for (const std::int32_t g : groups.of) {
    if (g >= 0) t.prolongation.column.push_back(g);
    t.prolongation.start.push_back(std::int32_t(t.prolongation.column.size()));
  }
  t.prolongation.value.resize(t.prolongation.column.size() * block);
  t.reduced.resize(std::size_t(groups.count) * node_functions * node_functions);
  const Members members = members_of(groups);
  for_rows(groups.count, threads, [&](std::int64_t g) {
    std::vector<double> q;
    for (const std::int64_t i : members.of(g))
      q.insert(q.end(), candidates.begin() + i * block, candidates.begin() + (i + 1) * block);
    std::ranges::copy(orthonormalise(q), t.reduced.begin() + g * node_functions * node_functions);
    const double* own = q.data();
    for (const std::int32_t i : members.of(g)) {
      std::copy_n(own, block,
                  t.prolongation.value.begin() + std::int64_t(t.prolongation.start[i]) * block);
      own += block;
    }
  });
  return t;
}

Coarsening coarsen(const BlockMatrix& matrix, const std::vector<double>& inverse, double omega,
                   const BlockMatrix& tentative_prolongation, int threads) {
  Coarsening step;
  step.prolongation = smoothed(matrix, inverse, omega, tentative_prolongation, threads);
  step.image = multiply(matrix, step.prolongation, threads);
  step.restriction = transpose(step.prolongation);
  step.coarse = multiply_transposed(step.prolongation, step.restriction, step.image, threads);
  return step;
}

void fold(Coarsening& step, const BlockMatrix& a, const std::vector<double>& inverse, int threads) {
  constexpr double once = Smoother::keep * Smoother::first + Smoother::second;
  constexpr double twice = Smoother::second * Smoother::first;
  BlockMatrix scaled = step.image;
  for_rows(a.rows, threads, [&](std::int64_t row) { scale_row(scaled, row, twice, inverse); });
  BlockMatrix prolongation = multiply(a, scaled, threads);
  for_rows(a.rows, threads, [&](std::int64_t row) {
    scale_row(prolongation, row, 1, inverse);
    scale_row(step.image, row, -once, inverse);
    add_row(prolongation, step.image, row);
    add_row(prolongation, step.prolongation, row);
  });
  step.prolongation = std::move(prolongation);
  step.restriction = transpose(step.prolongation);
}

}  // namespace pd
