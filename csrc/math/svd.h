// Signed singular value decomposition of any 3x3 matrix, and from it the nearest rotation. Robust and slow: for rare
// cases.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"

namespace pd::inline PD_TARGET {

// One Jacobi rotation of columns p and q of B (and of V alike) that makes them orthogonal.
template <class T>
PD_HD bool orthogonalise(T (&b)[3][3], T (&v)[3][3], int p, int q) {
  const T pp = b[0][p] * b[0][p] + b[1][p] * b[1][p] + b[2][p] * b[2][p];
  const T qq = b[0][q] * b[0][q] + b[1][q] * b[1][q] + b[2][q] * b[2][q];
  const T pq = b[0][p] * b[0][q] + b[1][p] * b[1][q] + b[2][p] * b[2][q];
  if (!(absolute(pq) > epsilon<T>() * square_root(pp * qq)) || absolute(pq) < smallest<T>())
    return false;
  const T zeta = (qq - pp) / (pq + pq);
  const T tangent =
      (zeta >= T(0) ? T(1) : T(-1)) / (absolute(zeta) + square_root(T(1) + zeta * zeta));
  const T c = T(1) / square_root(T(1) + tangent * tangent), s = c * tangent;
  for (int r = 0; r < 3; ++r) {
    const T bp = b[r][p], vp = v[r][p];
    b[r][p] = c * bp - s * b[r][q];
    b[r][q] = s * bp + c * b[r][q];
    v[r][p] = c * vp - s * v[r][q];
    v[r][q] = s * vp + c * v[r][q];
  }
  return true;
}

// Exchanges columns p and q to put the longer one first; the sign keeps det V = +1.
template <class T>
PD_HD void order_columns(T (&b)[3][3], T (&v)[3][3], T (&length2)[3], int p, int q) {
  if (!(length2[p] < length2[q])) return;
  const T keep = length2[p];
  length2[p] = length2[q];
  length2[q] = keep;
  for (int r = 0; r < 3; ++r) {
    const T bp = b[r][p], vp = v[r][p];
    b[r][p] = b[r][q];
    b[r][q] = -bp;
    v[r][p] = v[r][q];
    v[r][q] = -vp;
  }
}

// A unit vector orthogonal to `u`: `v` carried by the smallest rotation that takes `from` to `u`.
template <class T>
PD_HD Vec3<T> carried(const Vec3<T>& u, const Vec3<T>& from, const Vec3<T>& v) {
  const T c = dot(from, u);
  Vec3<T> w = v;
  if (c > T(-0.99)) {
    w = v - (dot(u, v) / (T(1) + c)) * (u + from);
  }
  w = w - dot(w, u) * u;
  return (T(1) / square_root(dot(w, w))) * w;
}

// F = U diag(s) V^T with det U = det V = +1 and s_0 >= s_1 >= |s_2|: s_2 has the sign of det F.
template <class T>
struct SignedSvd {
  Mat3<T> u, v;
  T s[3];

  // argmax over rotations R of tr(R^T F)
  PD_HD Mat3<T> rotation() const { return u * transpose(v); }
};

// One-sided Jacobi: F V = U S with det V = +1, U completed to det U = +1. F = 0 gives identities; a NaN or infinity gives NaN.
template <class T>
PD_HD SignedSvd<T> signed_svd(const Mat3<T>& f) {
  T b[3][3] = {{f.row[0].x, f.row[0].y, f.row[0].z},
               {f.row[1].x, f.row[1].y, f.row[1].z},
               {f.row[2].x, f.row[2].y, f.row[2].z}};
  T v[3][3] = {{T(1), T(0), T(0)}, {T(0), T(1), T(0)}, {T(0), T(0), T(1)}};
  T largest = T(0), sum = T(0);
  for (int i = 0; i < 9; ++i)
    largest = absolute(b[i / 3][i % 3]) > largest ? absolute(b[i / 3][i % 3]) : largest;
  const T scale = largest > T(0) ? largest : T(1);
  for (int i = 0; i < 9; ++i) sum = sum + (b[i / 3][i % 3] = b[i / 3][i % 3] / scale);
  // zero for finite F, NaN otherwise
  const T poison = sum - sum;
  if (!(largest > T(0)) || !(poison == T(0))) {
    const Mat3<T> same = {{{T(1) + poison, poison, poison},
                           {poison, T(1) + poison, poison},
                           {poison, poison, T(1) + poison}}};
    const Mat3<T> one = {{{T(1), T(0), T(0)}, {T(0), T(1), T(0)}, {T(0), T(0), T(1)}}};
    return {same, one, {poison, poison, poison}};
  }
  for (int sweep = 0; sweep < 10; ++sweep) {
    bool turned = orthogonalise(b, v, 0, 1);
    turned = orthogonalise(b, v, 0, 2) || turned;
    turned = orthogonalise(b, v, 1, 2) || turned;
    if (!turned) break;
  }
  T length2[3];
  for (int c = 0; c < 3; ++c)
    length2[c] = b[0][c] * b[0][c] + b[1][c] * b[1][c] + b[2][c] * b[2][c];
  order_columns(b, v, length2, 0, 1);
  order_columns(b, v, length2, 0, 2);
  order_columns(b, v, length2, 1, 2);

  const Vec3<T> v0 = {v[0][0], v[1][0], v[2][0]}, v1 = {v[0][1], v[1][1], v[2][1]},
                v2 = {v[0][2], v[1][2], v[2][2]};
  const T s0 = square_root(length2[0]);
  const Vec3<T> u0 = (T(1) / s0) * Vec3<T>{b[0][0], b[1][0], b[2][0]};
  Vec3<T> u1 = {b[0][1], b[1][1], b[2][1]};
  u1 = u1 - dot(u1, u0) * u0;
  const T s1 = square_root(dot(u1, u1));
  u1 = s1 > T(4) * epsilon<T>() * s0 ? (T(1) / s1) * u1 : carried(u0, v0, v1);
  const Vec3<T> u2 = cross(u0, u1);
  const T s2 = dot(u2, Vec3<T>{b[0][2], b[1][2], b[2][2]});
  return {from_columns(u0, u1, u2), from_columns(v0, v1, v2), {scale * s0, scale * s1, scale * s2}};
}

// The nearest rotation, which never fails. F = 0 gives the identity; a NaN or infinity gives NaN.
template <class T>
PD_HD Mat3<T> rotation_by_svd(const Mat3<T>& f) {
  return signed_svd(f).rotation();
}

}  // namespace pd::inline PD_TARGET
