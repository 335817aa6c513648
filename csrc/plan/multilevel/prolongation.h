// Prolongations between levels, by smoothed aggregation (Vanek, Mandel and Brezina 1996).
#pragma once

#include "plan/multilevel/aggregate.h"
#include "plan/multilevel/block_matrix.h"

#include <vector>

namespace pd {

constexpr int node_functions = 4;  // of an aggregate: 1, x, y, z

// The tentative prolongation: candidates [rows, height, 4], made orthonormal on each aggregate.
struct Tentative {
  BlockMatrix prolongation;     // one block a row
  std::vector<double> reduced;  // R [aggregates, 4, 4]: the candidates of the next level
};

Tentative tentative(const std::vector<double>& candidates, int height, const Aggregates& groups,
                    int threads);

// The prolongation from the level below, its transpose, and the Galerkin matrix of that level.
struct Coarsening {
  BlockMatrix prolongation, image;  // P, A P
  Transposed restriction;
  BlockMatrix coarse;
};

// `inverse`: 1 / D of `matrix`. The prolongation is (I - omega D^-1 A) P of the tentative P.
Coarsening coarsen(const BlockMatrix& matrix, const std::vector<double>& inverse, double omega,
                   const BlockMatrix& tentative_prolongation, int threads);

// Folds smoothing into the prolongation and its transpose, as a GPU needs it: (I - S A) P with a level's smoother
// S = (keep first + second) D^-1 - second first D^-1 A D^-1.
void fold(Coarsening& step, const BlockMatrix& a, const std::vector<double>& inverse, int threads);

}  // namespace pd
