// The small problem of the solver "corotated". Where parts of a body turn, A is far too stiff: it holds every element to the
// rotation that it has. On a space V of such motions the second derivative of the energy takes the place of A:
//
//   V Hc^-1 V^T + (I - V Ac^-1 (A V)^T) M (I - A V Ac^-1 V^T),   Ac = V^T A V,
//
// which is positive whatever M is (deflation, Nicolaides 1987). V has the rigid motions of four overlapping groups of vertices
// with weights w_k: w_k e_a and w_k e_a x r. Hc is that of corotated linear elasticity, a |dx|^2 + w V |sym(dF R^T)|^2, which is
// positive as well. All of it follows from products of sixteen numbers a vertex, (w_k, w_k r), with others.
#pragma once
#include "math/mat.h"

#include <cmath>

namespace pd::inline PD_TARGET {

constexpr int turning_groups = 4;
constexpr int turning_numbers = 4 * turning_groups;  // w and w r of each
constexpr int turning_modes = 6 * turning_groups;    // three translations, three turns of each
constexpr int turning_pairs = turning_modes * (turning_modes + 1) / 2;

constexpr double turning_noise = 1e-6;  // of Ac: modes that depend on others
constexpr int turning_begins = 3;       // iterations before: the first iterates are too far away
constexpr int turning_doubts = 3;       // failed trials that make it out of date
constexpr int turning_most = 3;         // times that a step makes it, the first one too

// Where the product of two modes stands, i not before j: group by group, the modes of one with those of the other.
PD_HD constexpr int turning_pair(int i, int j) {
  const int k = i / 6, l = j / 6, first = 21 * k + 36 * (k * (k - 1) / 2) + 36 * l;
  return first + (k == l ? (i % 6) * (i % 6 + 1) / 2 + j % 6 : 6 * (i % 6) + j % 6);
}

// Whether number c of TurningStrain is more than zero for a mode: three translations, three turns.
PD_HD constexpr bool strain_has(int mode, int c) {
  constexpr bool has[6][6] = {
      {true, false, false, true, true, false}, {false, true, false, true, false, true},
      {false, false, true, false, true, true}, {false, true, true, true, true, true},
      {true, false, true, true, true, true},   {true, true, false, true, true, true}};
  return has[mode][c];
}

struct TurningMatrix {
  double at[turning_modes][turning_modes] = {};

  PD_HD void multiply(const double (&x)[turning_modes], double (&y)[turning_modes]) const {
    for (int i = 0; i < turning_modes; ++i) {
      y[i] = 0;
      for (int j = 0; j < turning_modes; ++j) y[i] += at[i][j] * x[j];
    }
  }
};

// visit(a, b, c, sign) for the permutations of the axes
template <class Visit>
PD_HD void each_turn(const Visit& visit) {
  for (int a = 0; a < 3; ++a) {
    visit(a, (a + 1) % 3, (a + 2) % 3, 1);
    visit(a, (a + 2) % 3, (a + 1) % 3, -1);
  }
}

// sum V_i . W_i over vertices, for sums p of products of their sixteen numbers
PD_HD void add_products(const double (&p)[turning_numbers][turning_numbers], TurningMatrix& to) {
  for (int k = 0; k < turning_groups; ++k) {
    for (int l = 0; l < turning_groups; ++l) {
      const int row = 6 * k, column = 6 * l, m = 4 * k, n = 4 * l;
      double trace = 0;
      for (int c = 1; c < 4; ++c) trace += p[m + c][n + c];
      for (int a = 0; a < 3; ++a) {
        to.at[row + a][column + a] += p[m][n];
        to.at[row + 3 + a][column + 3 + a] += trace;
        for (int b = 0; b < 3; ++b) to.at[row + 3 + a][column + 3 + b] -= p[m + 1 + b][n + 1 + a];
      }
      each_turn([&](int a, int b, int c, int sign) {
        to.at[row + a][column + 3 + b] += sign * p[m][n + 1 + c];
        to.at[row + 3 + b][column + a] += sign * p[m + 1 + c][n];
      });
    }
  }
}

// V^T q, for sums of the sixteen numbers times q
PD_HD void modes_of(const double (&sum)[turning_numbers][3], double (&mode)[turning_modes]) {
  for (int k = 0; k < turning_groups; ++k) {
    for (int a = 0; a < 3; ++a) {
      mode[6 * k + a] = sum[4 * k][a];
      mode[6 * k + 3 + a] = 0;
    }
    each_turn([&](int a, int b, int c, int sign) {
      mode[6 * k + 3 + a] += sign * sum[4 * k + 1 + b][c];
    });
  }
}

// what times the sixteen numbers of a vertex gives V mode there
PD_HD void vectors_of(const double (&mode)[turning_modes], double (&vector)[turning_numbers][3]) {
  for (int k = 0; k < turning_groups; ++k) {
    for (int a = 0; a < 3; ++a) {
      vector[4 * k][a] = mode[6 * k + a];
      vector[4 * k + 1 + a][a] = 0;
    }
    each_turn([&](int a, int b, int c, int sign) {
      vector[4 * k + 1 + c][a] = sign * mode[6 * k + 3 + b];
    });
  }
}

// (X + noise diag Ac)^-1 in the scale of the diagonal of Ac, nothing for modes that move nothing; false where X is not positive.
PD_HD bool invert(const TurningMatrix& x, const double (&scale)[turning_modes], double noise,
                  TurningMatrix& inverse) {
  constexpr int n = turning_modes;
  double l[n][n] = {};  // L, then L^-1, of the scaled matrix
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j <= i; ++j) {
      double rest = scale[i] * scale[j] * 0.5 * (x.at[i][j] + x.at[j][i]);
      if (i == j) rest += scale[i] > 0 ? noise : 1;
      for (int k = 0; k < j; ++k) rest -= l[i][k] * l[j][k];
      if (i == j && !(rest > 0)) return false;
      l[i][j] = i == j ? sqrt(rest) : rest / l[j][j];
    }
  }
  for (int j = 0; j < n; ++j) {
    l[j][j] = 1 / l[j][j];
    for (int i = j + 1; i < n; ++i) {
      double rest = 0;
      for (int k = j; k < i; ++k) rest -= l[i][k] * l[k][j];
      l[i][j] = rest / l[i][i];
    }
  }
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) {
      double sum = 0;
      for (int k = i < j ? j : i; k < n; ++k) sum += l[k][i] * l[k][j];
      inverse.at[i][j] = scale[i] * scale[j] * sum;
    }
  }
  return true;
}

// Six numbers of sym(dF R^T), dF being what a mode does to an element: their products are those of the matrices.
// `rotation`: of Ds Dm^-1; `position`, `weight`: of the four corners.
template <class R>
struct TurningStrain {
  R h[turning_modes][6];

  PD_HD TurningStrain(const Mat3<R>& rest_inverse, const Mat3<R>& rotation,
                      const Vec3<R> (&position)[4], const R (&weight)[turning_groups][4]) {
    const Mat3<R> back = transpose(rotation);
    for (int k = 0; k < turning_groups; ++k) {
      const R(&w)[4] = weight[k];
      const Vec3<R> change = {w[1] - w[0], w[2] - w[0], w[3] - w[0]};
      const Vec3<R> g = rotation * (transpose(rest_inverse) * change);
      Vec3<R> moved[4];
      for (int c = 0; c < 4; ++c) moved[c] = w[c] * position[c];
      const Mat3<R> p =
          (from_columns(moved[1] - moved[0], moved[2] - moved[0], moved[3] - moved[0]) *
           rest_inverse) *
          back;
      const Vec3<R> none = {R(scalar_of<R>(0)), R(scalar_of<R>(0)), R(scalar_of<R>(0))};
      const Vec3<R> minus[3] = {-p.row[0], -p.row[1], -p.row[2]};
      set(6 * k, {{g, none, none}});
      set(6 * k + 1, {{none, g, none}});
      set(6 * k + 2, {{none, none, g}});
      set(6 * k + 3, {{none, minus[2], p.row[1]}});
      set(6 * k + 4, {{p.row[2], none, minus[0]}});
      set(6 * k + 5, {{minus[1], p.row[0], none}});
    }
  }

 private:
  PD_HD void set(int mode, const Mat3<R>& d) {
    const R root_half(scalar_of<R>(0.70710678118654752440));
    h[mode][0] = d.row[0].x;
    h[mode][1] = d.row[1].y;
    h[mode][2] = d.row[2].z;
    h[mode][3] = root_half * (d.row[0].y + d.row[1].x);
    h[mode][4] = root_half * (d.row[0].z + d.row[2].x);
    h[mode][5] = root_half * (d.row[1].z + d.row[2].y);
  }
};

}  // namespace pd::inline PD_TARGET
