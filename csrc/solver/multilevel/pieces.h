// The coarse space of L-BFGS with M: rigid motions of pieces, where A is far too stiff. It holds every element to the rotation
// that it has. On a space Z of such motions the second derivative of the energy takes the place of A:
//
//   Z Hc^-1 Z^T + (I - Z Ac^-1 (A Z)^T) M (I - A Z Ac^-1 Z^T),   Ac = Z^T A Z,   Hc = Z^T H Z,
//
// which is positive whatever M is (deflation, Nicolaides 1987). With M = A^-1 it is M + Z (Hc^-1 - Ac^-1) Z^T. That takes its
// place where M knows all of Hc, so that Hc is hardly above Ac: no contacts, nor springs much stiffer than M knows. Levels are so
// near to A^-1 on Z that iterations are as many, and nothing has to be summed up after M. There M comes times theta < 2.
//
// A vertex moves by the twists of up to four pieces with weights that add up to one, so pieces bend into each other. Z was taken at
// the positions where Hc was made. Turns to first order strain what is strained, within a piece too.
//
// H is the second derivative of each element by itself, its negative eigenvalues set to zero. The stiffness of what is stretched
// against turns is a part of it: without it a body of 1e8 Pa with strains of a half took eight times the iterations.
//
// Pins that M does not know: A is P A P and M is P M P there, P zero at their vertices. So nothing that goes into M pulls at what
// the pins leave as a whole, where M is a million times too soft.
//
// Contacts: with the projector P on what they leave free, P (..) P is what an iteration uses. M P alone would let a body that
// lies on the ground go down as if there were none: (P M P) instead of (P A P)^-1. The second term has no such motions, and Hc
// gets e^T A e, e = (I - P) dx, about what it costs the held vertices to stay behind.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"
#include "math/stretch.h"

#include <cmath>
#include <cstdint>

namespace pd::inline PD_TARGET {

constexpr int most_pieces = 64;      // a bit each of PieceMask
constexpr int pieces_of_vertex = 4;  // at most
constexpr int piece_modes = 6;       // three translations, three turns about its centre
constexpr int piece_block = piece_modes * piece_modes;

using PieceMask = std::uint64_t;

// It is made at this iterate, since the ones before are too far away; but where contacts may hold M leads far astray without.
constexpr int pieces_begin = 2, touching_pieces_begin = 1;

// Relative to the diagonal of Ac: above the rounding of motions that depend on others.
template <class T>
constexpr double piece_noise() {
  return sizeof(T) == 4 ? 1e-6 : 1e-12;
}

// Where the block of two of some pieces stands, `row` not before `column`.
PD_HD constexpr int piece_pair(int row, int column) { return row * (row + 1) / 2 + column; }
// Number of a pair of pieces where those of one piece come first.
PD_HD constexpr int piece_list(int pieces, int row, int column) {
  return row == column ? row : pieces + row * (row - 1) / 2 + column;
}

PD_HD int count_pieces(PieceMask mask) {
#if defined(__CUDA_ARCH__)
  return __popcll(mask);
#else
  return __builtin_popcountll(mask);
#endif
}

// An entry of sum a J_i^T J_j of the modes of two pieces, from sums k of a (1, r_i) (1, r_j)^T: J = [1, -[r]x].
PD_HD double rigid_entry(const double (&k)[4][4], int i, int j) {
  const int a = i % 3, b = j % 3, c = 3 - a - b;
  const bool turns = i >= 3, other_turns = j >= 3;
  if (turns && other_turns) return (a == b ? k[1][1] + k[2][2] + k[3][3] : 0) - k[1 + b][1 + a];
  if (turns == other_turns) return a == b ? k[0][0] : 0;
  if (a == b) return 0;
  const double product = turns ? -k[1 + c][0] : k[0][1 + c];
  return b == (a + 1) % 3 ? product : -product;
}

// 1 / sqrt(Ac_ii) of a mode, 0 where it moves nothing: a turn of vertices in line, which the rounding of positions moves.
// `shift`: Ac_ii of a translation of the piece; `centre`: of the piece, from the middle
template <class T>
PD_HD double mode_scale(int mode, double own, double shift, const Vec3<double>& centre) {
  constexpr double unit = 16 * double(epsilon<T>());
  const double least = mode < 3 ? 0 : unit * unit * dot(centre, centre) * shift;
  return own > least ? 1 / sqrt(own) : 0;
}

// The displacement by a mode at `arm` from the centre of its piece.
template <class R>
PD_HD Vec3<R> rigid_motion(int mode, const Vec3<R>& arm) {
  const R none(scalar_of<R>(0)), one(scalar_of<R>(1));
  const int a = mode % 3;
  if (mode < 3) return {a == 0 ? one : none, a == 1 ? one : none, a == 2 ? one : none};
  if (a == 0) return {none, -arm.z, arm.y};
  if (a == 1) return {arm.z, none, -arm.x};
  return {-arm.y, arm.x, none};
}

// Whether contacts take no direction from a vertex: a projector has less than this trace where they do.
template <class R>
PD_HD bool leaves_all(const Mat3<R>& free) {
  const R trace = (free.row[0].x + free.row[1].y) + free.row[2].z;
  return !any(trace < R(scalar_of<R>(2.5)));
}

// Whether number c of PieceStrain is more than zero for a mode: three translations, three turns.
PD_HD constexpr bool strain_moves(int mode, int c) {
  constexpr bool moves[6][6] = {
      {true, false, false, true, true, false}, {false, true, false, true, false, true},
      {false, false, true, false, true, true}, {false, true, true, true, true, true},
      {true, false, true, true, true, true},   {true, true, false, true, true, true}};
  return c >= 6 || moves[mode][c];
}

// A tetrahedron at F: R^T, and what twists about the axes u_k of its stretches cost beside none: 1 - 2 / (s_i + s_j), at least 0,
// where tension takes its share of the 2.
template <class R>
struct PieceFrame {
  Mat3<R> back;
  Vec3<R> twist[3];  // u_k times the root of half of that

  // `weight`: V 2 mu; `pressure`: V lambda
  PD_HD PieceFrame(const Mat3<R>& f, const R& weight, const R& pressure) {
    using T = scalar_of<R>;
    const R none(T(0)), one(T(1));
    const Mat3<R> rotation = nearest_rotation(f);
    back = transpose(rotation);
    const Stretches<R> at(f, rotation);
    const R trace = ((at.s[0] + at.s[1]) + at.s[2]) - R(T(3));
    const R known = select(none < weight, weight, one);
    find_twists(at, one - lesser(pressure * trace, known) / known);
  }
  // `share` of the 2 that tension leaves
  PD_HD PieceFrame(const Mat3<R>& f, const Mat3<R>& rotation, const R& share)
      : back(transpose(rotation)) {
    find_twists(Stretches<R>(f, rotation), share);
  }

 private:
  PD_HD void find_twists(const Stretches<R>& at, const R& share) {
    using T = scalar_of<R>;
    const R one(T(1));
    for (int k = 0; k < 3; ++k) {
      const R sum = at.s[(k + 1) % 3] + at.s[(k + 2) % 3], least(smallest<T>() * T(4));
      const R soft = lesser(one, R(T(2)) * share / greater(sum, least));
      twist[k] = square_root(R(T(0.5)) * (one - soft)) * at.left[k];
    }
  }
};

// Strain of a tetrahedron by the modes of a piece: six numbers of sym(dF R^T), whose products are those of the matrices, and three
// of its twists. dF R^T of a translation along e is e g^T, that of a turn about e is e x p.
template <class R>
struct PieceStrain {
  static constexpr int numbers = 9;
  R h[piece_modes][numbers];

  PieceStrain() = default;
  // `arm`: corners from the centre of the piece; `weight`: of the corners in it
  PD_HD PieceStrain(const Mat3<R>& rest_inverse, const PieceFrame<R>& frame,
                    const Vec3<R> (&arm)[4], const R (&weight)[4]) {
    const Vec3<R> change = {weight[1] - weight[0], weight[2] - weight[0], weight[3] - weight[0]};
    const Vec3<R> g = (change * rest_inverse) * frame.back;
    Vec3<R> moved[4];
    for (int c = 0; c < 4; ++c) moved[c] = weight[c] * arm[c];
    const Mat3<R> p = (from_columns(moved[1] - moved[0], moved[2] - moved[0], moved[3] - moved[0]) *
                       rest_inverse) *
                      frame.back;
    const R zero(scalar_of<R>(0));
    const Vec3<R> none = {zero, zero, zero};
    set(0, frame, {{g, none, none}});
    set(1, frame, {{none, g, none}});
    set(2, frame, {{none, none, g}});
    set(3, frame, {{none, -p.row[2], p.row[1]}});
    set(4, frame, {{p.row[2], none, -p.row[0]}});
    set(5, frame, {{-p.row[1], p.row[0], none}});
  }

  // the stress to each: 2 mu V strain + lambda V trace
  template <bool Dilates>
  PD_HD PieceStrain stressed(const R& weight, const R& pressure) const {
    PieceStrain stress;
    for (int i = 0; i < piece_modes; ++i) {
      for (int c = 0; c < numbers; ++c) stress.h[i][c] = weight * h[i][c];
      if (!Dilates) continue;
      const R part = pressure * ((h[i][0] + h[i][1]) + h[i][2]);
      for (int c = 0; c < 3; ++c) stress.h[i][c] = stress.h[i][c] + part;
    }
    return stress;
  }

 private:
  PD_HD void set(int mode, const PieceFrame<R>& frame, const Mat3<R>& d) {
    const R root_half(scalar_of<R>(0.70710678118654752440));
    h[mode][0] = d.row[0].x;
    h[mode][1] = d.row[1].y;
    h[mode][2] = d.row[2].z;
    h[mode][3] = root_half * (d.row[0].y + d.row[1].x);
    h[mode][4] = root_half * (d.row[0].z + d.row[2].x);
    h[mode][5] = root_half * (d.row[1].z + d.row[2].y);
    const Vec3<R> axis = {d.row[2].y - d.row[1].z, d.row[0].z - d.row[2].x,
                          d.row[1].x - d.row[0].y};
    for (int k = 0; k < 3; ++k) h[mode][6 + k] = dot(frame.twist[k], axis);
  }
};

// sum += the products of the strains of two pieces; of six numbers of a strain half are none. `stress`: by `Dilates`.
template <bool Dilates, class R>
PD_HD void add_strain_products(const PieceStrain<R>& stress, const PieceStrain<R>& strain, R* sum) {
  PD_UNROLL
  for (int i = 0; i < piece_modes; ++i) {
    PD_UNROLL
    for (int j = 0; j < piece_modes; ++j) {
      R total = sum[piece_modes * i + j];
      PD_UNROLL
      for (int c = 0; c < PieceStrain<R>::numbers; ++c) {
        const bool moves = strain_moves(i, c) || (Dilates && c < 3);
        if (moves && strain_moves(j, c))
          total = multiply_add(stress.h[i][c], strain.h[j][c], total);
      }
      sum[piece_modes * i + j] = total;
    }
  }
}

// A symmetric matrix with its negative eigenvalues set to zero, by Jacobi's method without branches over lanes.
template <int N, class R>
PD_HD void clamp_positive(R (&a)[N][N]) {
  using T = scalar_of<R>;
  const R none(T(0)), one(T(1)), two(T(2));
  R v[N][N], size = none;
  for (int i = 0; i < N; ++i) {
    for (int j = 0; j < N; ++j) {
      v[i][j] = i == j ? one : none;
      size = size + select(a[i][j] < none, -a[i][j], a[i][j]);
    }
  }
  const R least = R(T(0.125) * epsilon<T>()) * size;
  const auto rotate = [&](int p, int q) {
    const R off = a[p][q], apart = a[q][q] - a[p][p];
    const auto goes = least < select(off < none, -off, off);
    if (!any(goes)) return false;
    const R root = square_root(multiply_add(apart, apart, R(T(4)) * (off * off)));
    const R under = select(apart < none, apart - root, apart + root);
    const R safe = select(goes, under, one), t = select(goes, two * off / safe, none);
    const R c = one / square_root(multiply_add(t, t, one)), s = c * t;
    for (int i = 0; i < N; ++i) {
      const R x = a[i][p], y = a[i][q];
      a[i][p] = subtract_product(c * x, s, y);
      a[i][q] = multiply_add(s, x, c * y);
    }
    for (int i = 0; i < N; ++i) {
      const R x = a[p][i], y = a[q][i], vx = v[i][p], vy = v[i][q];
      a[p][i] = subtract_product(c * x, s, y);
      a[q][i] = multiply_add(s, x, c * y);
      v[i][p] = subtract_product(c * vx, s, vy);
      v[i][q] = multiply_add(s, vx, c * vy);
    }
    return true;
  };
  bool goes_on = true;
  for (int sweep = 0; sweep < 10 && goes_on; ++sweep) {
    goes_on = false;
    for (int p = 0; p < N; ++p) {
      for (int q = p + 1; q < N; ++q) goes_on = rotate(p, q) || goes_on;
    }
  }
  R value[N];
  for (int k = 0; k < N; ++k) value[k] = select(none < a[k][k], a[k][k], none);
  for (int i = 0; i < N; ++i) {
    for (int j = 0; j <= i; ++j) {
      R sum = none;
      for (int k = 0; k < N; ++k) sum = multiply_add(value[k] * v[i][k], v[j][k], sum);
      a[i][j] = a[j][i] = sum;
    }
  }
}

}  // namespace pd::inline PD_TARGET
