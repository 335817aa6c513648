// The small problem of L-BFGS on a GPU; that of a CPU: solver/multilevel/pieces.h. A is far too stiff where parts turn: it holds every element to the
// rotation that it has. On a space V of such motions the second derivative of the energy takes the place of A:
//
//   V Hc^-1 V^T + (I - V Ac^-1 (A V)^T) M (I - A V Ac^-1 V^T),   Ac = V^T A V,
//
// which is positive whatever M is (deflation, Nicolaides 1987). With M = A^-1 it is M + V (Hc^-1 - Ac^-1) V^T, and that takes its
// place where nothing but elements and inertias that M knows makes Hc, so that Hc <= Ac: no contacts, nor springs much stiffer
// than M knows. Levels are so near to A^-1 on V (0.79 of it at least, on slivers; 0.95 on even meshes) that iterations are as
// many, and nothing has to be summed up after M. There M comes times theta < 2, and what it has of V must be 1 - 1 / theta of
// A^-1 at least for the whole to be positive, 0.44 for the theta of 1.8.
//
// V has the rigid motions of four overlapping groups of vertices with weights w_k: w_k e_a and w_k e_a x r. Hc is that of
// corotated linear elasticity, a |dx|^2 + w V |sym(dF R^T)|^2, which is positive as well. All of it follows from products of
// sixteen numbers a vertex, (w_k, w_k r), with others.
//
// Contacts: with the projector P on what they leave free, P (..) P is what an iteration uses. M P alone would let a body that
// lies on the ground go down as if there were none: (P M P) instead of (P A P)^-1. The second term has no such motions, and Hc
// gets the springs sum D_i |(I - P_i) dx_i|^2, about what it costs a vertex to stay behind.
#pragma once
#include "math/mat.h"

#include <cmath>

namespace pd::inline PD_TARGET {

constexpr int turning_groups = 4;
constexpr int turning_numbers = 4 * turning_groups;  // w and w r of each
constexpr int turning_modes = 6 * turning_groups;    // three translations, three turns of each
constexpr int turning_pairs = turning_modes * (turning_modes + 1) / 2;

constexpr double turning_noise = 1e-6;  // of Ac: modes that depend on others
constexpr int turning_begins = 3;       // iterations before: the first iterates are too far away,
constexpr int touching_begins = 1;      // but where contacts may hold M leads far astray without

// Without contacts:
constexpr int turning_doubts = 3;  // failed trials that make it out of date
constexpr int turning_most = 3;    // times that a step makes it, the first one too

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

// Whether the small problem is to be made at iteration k, which it was `made` times before, `failed` trials ago. If not, whether
// it is to be forgotten: a step that goes on failing does without, but for contacts. There it is made anew where `turns`.
struct TurningPlan {
  bool make, forget;

  PD_HD TurningPlan(int k, int made, int failed, bool touching, bool turns) {
    const bool doubted = made > 0 && failed >= turning_doubts && !touching;
    const int begins = touching ? touching_begins : turning_begins;
    make = made == 0 ? k >= begins : touching ? turns : doubted && made < turning_most;
    forget = doubted && !make;
  }
};

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

// sum V_i . W_j over vertices, for sums p of products of their sixteen numbers
PD_HD double mode_product(const double (&p)[turning_numbers][turning_numbers], int i, int j) {
  const int m = 4 * (i / 6), n = 4 * (j / 6), a = i % 3, b = j % 3, c = 3 - a - b;
  const bool turns = i % 6 >= 3, other_turns = j % 6 >= 3;
  if (turns && other_turns) {
    const double trace = p[m + 1][n + 1] + p[m + 2][n + 2] + p[m + 3][n + 3];
    return (a == b ? trace : 0) - p[m + 1 + b][n + 1 + a];
  }
  if (turns == other_turns) return a == b ? p[m][n] : 0;
  if (a == b) return 0;
  const bool even = b == (a + 1) % 3;  // the permutation (a, b, c)
  const double product = turns ? -p[m + 1 + c][n] : p[m][n + 1 + c];
  return even ? product : -product;
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

// Modes in the scale of the diagonal of Ac, 0 for one that moves nothing.
PD_HD double turning_scale(const TurningMatrix& matrix, int i) {
  return matrix.at[i][i] > 0 ? 1 / sqrt(matrix.at[i][i]) : 0;
}

// X + noise diag Ac in that scale, one where a mode moves nothing
PD_HD double scaled_entry(const TurningMatrix& x, double scale_i, double scale_j, int i, int j,
                          double noise) {
  const double entry = scale_i * scale_j * 0.5 * (x.at[i][j] + x.at[j][i]);
  return i != j ? entry : entry + (scale_i > 0 ? noise : 1);
}

// Step k of the sweeps that turn a positive matrix into minus its inverse (Goodnight 1979): what entry (i, j) becomes.
// `share` is one over the pivot, which is positive.
PD_HD double swept(const TurningMatrix& a, int k, double share, int i, int j) {
  if (i == k && j == k) return -share;
  if (i == k || j == k) return share * a.at[i][j];
  return a.at[i][j] - share * (a.at[i][k] * a.at[k][j]);
}

// What the modes of a group do to an element: dF R^T of a translation along e is e g^T, that of a turn about e is e x p.
// `back`: R^T of Ds Dm^-1; `position`, `weight`: of the four corners.
template <class R>
struct TurningGradient {
  Vec3<R> g;
  Mat3<R> p;

  PD_HD TurningGradient(const Mat3<R>& rest_inverse, const Mat3<R>& back,
                        const Vec3<R> (&position)[4], const R (&weight)[4]) {
    const Vec3<R> change = {weight[1] - weight[0], weight[2] - weight[0], weight[3] - weight[0]};
    g = (change * rest_inverse) * back;
    Vec3<R> moved[4];
    for (int c = 0; c < 4; ++c) moved[c] = weight[c] * position[c];
    p = (from_columns(moved[1] - moved[0], moved[2] - moved[0], moved[3] - moved[0]) *
         rest_inverse) *
        back;
  }
  PD_HD TurningGradient(const Vec3<R>& gradient, const Mat3<R>& product)
      : g(gradient), p(product) {}
};

// Six numbers of the symmetric part of that for each mode of a group: their products are those of the matrices.
template <class R>
struct TurningStrain {
  R h[6][6];

  TurningStrain() = default;
  PD_HD explicit TurningStrain(const TurningGradient<R>& of) {
    const Vec3<R> none = {R(scalar_of<R>(0)), R(scalar_of<R>(0)), R(scalar_of<R>(0))};
    const Mat3<R>& p = of.p;
    set(0, {{of.g, none, none}});
    set(1, {{none, of.g, none}});
    set(2, {{none, none, of.g}});
    set(3, {{none, -p.row[2], p.row[1]}});
    set(4, {{p.row[2], none, -p.row[0]}});
    set(5, {{-p.row[1], p.row[0], none}});
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

// sum += the product of the strains of two modes, 0 to 5 of their groups: of six numbers half are none. `Dilates`: `a` has
// the trace's part of a dilated_strain.
template <bool Dilates = false, class R>
PD_HD void add_strain_product(const R (&a)[6], int i, const R (&b)[6], int j, R& sum) {
  PD_UNROLL
  for (int c = 0; c < 6; ++c) {
    const bool has = strain_has(i, c) || (Dilates && c < 3);
    if (has && strain_has(j, c)) sum = multiply_add(a[c], b[c], sum);
  }
}

// Adds the part of lambda to 2 mu V times a strain, for its product with another: V lambda / 3 tr(a) tr(b). A third of
// lambda keeps Hc <= Ac, since tr(dF)^2 <= 3 |dF|^2 and Ac weighs |dF|^2 with 2 mu + lambda.
template <class R>
PD_HD void add_dilation(const R (&strain)[6], const R& pressure, R (&weighted)[6]) {
  const R trace = (strain[0] + strain[1]) + strain[2];
  const R part = R(scalar_of<R>(1.0 / 3.0)) * pressure * trace;
  for (int c = 0; c < 3; ++c) weighted[c] = weighted[c] + part;
}

}  // namespace pd::inline PD_TARGET
