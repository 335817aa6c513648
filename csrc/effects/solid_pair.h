// Elastic solids two at a time: tetrahedra that share the face of corners 0, 1 and 2, with the apexes 3 and 4.
//
// Their rest shapes stand in a frame of that face, the first axis along the edge from corner 0 to corner 1, the third normal to
// the face. There Dm^-1 is upper triangular, and all but its last column is the same for both:
//
//   F = Ds Dm^-1 = [p e_1,  q e_1 + r e_2,  s e_1 + t e_2 + h e_3],   e_c = x_c - x_0,
//
// p, q, r of the face, s, t, h of a tetrahedron. With Q the turn into the frame, F Q^T stands here in place of the F of
// effects/solid.h and R Q^T in place of its R, so energies and forces are the same, for three quarters of the operations.
#pragma once
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

template <class R>
struct FaceRest {
  R p, q, r;        // [1/m]
  Vec3<R> apex[2];  // s, t, h of either tetrahedron [1/m]

  // Dm^-1 of one of them
  PD_HD Mat3<R> inverse(int which) const {
    const R none(scalar_of<R>(0));
    const Vec3<R>& a = apex[which];
    return {{{p, q, a.x}, {none, r, a.y}, {none, none, a.z}}};
  }
};

// The columns that both deformation gradients have, f_1 and f_2, and the third of both their cofactors.
template <class R>
struct FaceColumns {
  Vec3<R> first, second, normal;        // normal = f_1 x f_2
  R first2, second2, between, normal2;  // |f_1|^2, |f_2|^2, f_1.f_2, |normal|^2

  PD_HD FaceColumns(const Vec3<R> (&edge)[2], const FaceRest<R>& rest)
      : first(rest.p * edge[0]), second(multiply_add(rest.r, edge[1], rest.q * edge[0])) {
    normal = cross(first, second);
    first2 = dot(first, first);
    second2 = dot(second, second);
    between = dot(first, second);
    normal2 = dot(normal, normal);
  }

  PD_HD Mat3<R> with(const Vec3<R>& third) const { return from_columns(first, second, third); }

  PD_HD Invariants<R> invariants(const Vec3<R>& third) const {
    const Vec3<R> a = cross(second, third), b = cross(third, first);
    return {(first2 + second2) + dot(third, third), (dot(a, a) + dot(b, b)) + normal2,
            dot(third, normal)};
  }

  // a F + b F F^T F + c cof F, column by column: F F^T F = F (F^T F)
  PD_HD void combine(const Vec3<R>& third, const R& a, const R& b, const R& c,
                     Vec3<R> (&column)[3]) const {
    const R one_three = b * dot(first, third), two_three = b * dot(second, third);
    const R one_two = b * between, three_three = multiply_add(b, dot(third, third), a);
    const auto sum = [&](const R& one, const R& two, const R& three, const Vec3<R>& cofactor) {
      return multiply_add(c, cofactor,
                          multiply_add(three, third, multiply_add(two, second, one * first)));
    };
    column[0] = sum(multiply_add(b, first2, a), one_two, one_three, cross(second, third));
    column[1] = sum(one_two, multiply_add(b, second2, a), two_three, cross(third, first));
    column[2] = sum(one_three, two_three, three_three, normal);
  }
};

// weight (F - R), column by column; compare finish_strain.
template <class R>
PD_HD void finish_columns(const FaceColumns<R>& face, const Vec3<R>& third, const Invariants<R>& i,
                          const Root<R>& root, const R& weight, Vec3<R> (&column)[3]) {
  const ClosedForm<R> form(i, root.value);
  face.combine(third, weight * (R(scalar_of<R>(1)) - form.diagonal), weight * form.scale,
               -weight * form.twist, column);
  const auto good = trusted(i, root);
  if (any(!good)) [[unlikely]] {
    const Mat3<R> f = face.with(third);
    Mat3<R> r = f;
    repair_rotation(f, good, r);
    const Mat3<R> other = transpose(weight * (f - r)), same = {{column[0], column[1], column[2]}};
    const Mat3<R> chosen = select(good, same, other);
    for (int c = 0; c < 3; ++c) column[c] = chosen.row[c];
  }
}

// Gradient on the five corners; with `Energy` strains of weight one, whose halved squares times the weights are added to
// `energy` where they are `wanted`.
template <bool Energy, class R>
PD_HD void solid_pair_gradient(const Vec3<R> (&x)[5], const FaceRest<R>& rest, const R (&weight)[2],
                               bool wanted, Vec3<R> (&g)[5], R& energy) {
  const Vec3<R> edge[2] = {x[1] - x[0], x[2] - x[0]};
  const FaceColumns<R> face(edge, rest);
  Vec3<R> third[2];
  Invariants<R> i[2];
  Root<R> root[2];
  for (int e = 0; e < 2; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    third[e] =
        multiply_add(apex.z, x[3 + e] - x[0], multiply_add(apex.y, edge[1], apex.x * edge[0]));
    i[e] = face.invariants(third[e]);
  }
  for (int e = 0; e < 2; ++e) root[e] = largest_root(i[e]);
  Vec3<R> stress[2][3];
  for (int e = 0; e < 2; ++e) {
    Vec3<R>(&column)[3] = stress[e];
    finish_columns(face, third[e], i[e], root[e], Energy ? R(scalar_of<R>(1)) : weight[e], column);
    if (Energy) {
      if (wanted) {
        const R square =
            (dot(column[0], column[0]) + dot(column[1], column[1])) + dot(column[2], column[2]);
        energy = multiply_add(R(scalar_of<R>(0.5)) * weight[e], square, energy);
      }
      for (int c = 0; c < 3; ++c) column[c] = weight[e] * column[c];
    }
  }
  const Vec3<R> first = stress[0][0] + stress[1][0], second = stress[0][1] + stress[1][1];
  const auto apexes = [&](const R& one, const R& other, const Vec3<R>& sum) {
    return multiply_add(other, stress[1][2], multiply_add(one, stress[0][2], sum));
  };
  g[1] = apexes(rest.apex[0].x, rest.apex[1].x, multiply_add(rest.q, second, rest.p * first));
  g[2] = apexes(rest.apex[0].y, rest.apex[1].y, rest.r * second);
  for (int e = 0; e < 2; ++e) g[3 + e] = rest.apex[e].z * stress[e][2];
  g[0] = -((g[1] + g[2]) + (g[3] + g[4]));
}

}  // namespace pd::inline PD_TARGET
