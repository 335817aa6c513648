// Elastic solids by faces: one tetrahedron, or two that share a face, of corners 0, 1 and 2, with their apexes behind them.
//
// Their rest shapes stand in a frame of the face, the first axis along the edge from corner 0 to corner 1, the third normal to
// the face. There Dm^-1 is upper triangular, and all but its last column is the same for both:
//
//   F = Ds Dm^-1 = [p e_1,  q e_1 + r e_2,  s e_1 + t e_2 + h e_3],   e_c = x_c - x_0,
//
// p, q, r of the face, s, t, h of a tetrahedron. With Q the turn into the frame, F Q^T stands here in place of the F of
// effects/solid.h and R Q^T in place of its R, so energies and forces are the same. What two tetrahedra share is worked out once:
// that saves a GPU a sixth of the instructions (tools/instructions.py), and a tetrahedron alone a thirtieth.
#pragma once
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

// An effect that has a run_face, for one tetrahedron or two.
template <class Effect>
concept OnFaces = requires { requires Effect::on_faces; };

template <class R, int Count>
struct FaceRest {
  R p, q, r;            // [1/m]
  Vec3<R> apex[Count];  // s, t, h of each tetrahedron [1/m]

  // Dm^-1 of one of them
  PD_HD Mat3<R> inverse(int which) const {
    const R none(scalar_of<R>(0));
    const Vec3<R>& a = apex[which];
    return {{{p, q, a.x}, {none, r, a.y}, {none, none, a.z}}};
  }
};

// That of edges from corner 0 in any unit, `per_unit` of which make a metre, and of unit^2 / det Dm of each tetrahedron. In
// float32 edges are whole numbers up to 2^31: all squares and their inverses fit, and of a face that collapses in these
// units everything stays finite.
//
// s and t are -h times where the apex stands above the face, in the coordinates of its corners. They are as far off as if the
// apex were by roundings of itself times |e_1||e_2| / |e_1 x e_2|; h has all its bits, however flat the tetrahedron.
template <class R, int Count>
PD_HD FaceRest<R, Count> face_rest(const Vec3<R> (&edge)[2 + Count], const R& per_unit,
                                   const R (&per_determinant)[Count]) {
  using T = scalar_of<R>;
  const R least(sizeof(T) == 4 ? T(1) : smallest<T>());
  const auto no_less = [&](const R& a) { return select(a < least, least, a); };
  const Vec3<R>&first = edge[0], &second = edge[1];
  const Vec3<R> normal = exact_cross(first, second), ahead = cross(normal, first);
  const R length2 = no_less(dot(first, first)), normal2 = no_less(dot(normal, normal));
  const R per_length2 = reciprocal(length2), per_normal2 = reciprocal(normal2);
  const R height = rough_square_root(normal2), along = dot(first, second);
  FaceRest<R, Count> rest;
  rest.p = per_unit * rough_square_root(per_length2);
  rest.r = per_unit * rough_square_root(length2 * per_normal2);
  rest.q = -(along * per_length2) * rest.r;
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = edge[2 + e];
    const R h = height * per_determinant[e];
    const R other = per_normal2 * dot(ahead, apex);
    const R one = per_length2 * subtract_product(dot(first, apex), other, along);
    rest.apex[e] = {-(h * one), -(h * other), h};
  }
  return rest;
}

// The columns that all deformation gradients of a face have, f_1 and f_2, and the third of all their cofactors.
template <class R>
struct FaceColumns {
  Vec3<R> first, second, normal;        // normal = f_1 x f_2
  R first2, second2, between, normal2;  // |f_1|^2, |f_2|^2, f_1.f_2, |normal|^2

  template <int Count>
  PD_HD FaceColumns(const Vec3<R> (&edge)[2], const FaceRest<R, Count>& rest)
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

// Gradient on all corners; with `Energy` strains of weight one, whose halved squares times the weights are added to `energy`
// where they are `wanted`. One tetrahedron after the other, which takes the fewest registers.
template <bool Energy, class R, int Count>
PD_HD void solid_face_gradient(const Vec3<R> (&x)[3 + Count], const FaceRest<R, Count>& rest,
                               const R (&weight)[Count], bool wanted, Vec3<R> (&g)[3 + Count],
                               R& energy) {
  const Vec3<R> edge[2] = {x[1] - x[0], x[2] - x[0]};
  const FaceColumns<R> face(edge, rest);
  Vec3<R> third[Count];
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    third[e] =
        multiply_add(apex.z, x[3 + e] - x[0], multiply_add(apex.y, edge[1], apex.x * edge[0]));
  }
  Vec3<R> first, second;  // columns of stress of all tetrahedra
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    const Invariants<R> i = face.invariants(third[e]);
    Vec3<R> stress[3];
    finish_columns(face, third[e], i, largest_root(i), Energy ? R(scalar_of<R>(1)) : weight[e],
                   stress);
    if (Energy) {
      if (wanted) {
        const R square =
            (dot(stress[0], stress[0]) + dot(stress[1], stress[1])) + dot(stress[2], stress[2]);
        energy = multiply_add(R(scalar_of<R>(0.5)) * weight[e], square, energy);
      }
      for (Vec3<R>& column : stress) column = weight[e] * column;
    }
    g[3 + e] = apex.z * stress[2];
    first = e == 0 ? stress[0] : first + stress[0];
    second = e == 0 ? stress[1] : second + stress[1];
    g[1] = e == 0 ? apex.x * stress[2] : multiply_add(apex.x, stress[2], g[1]);
    g[2] = e == 0 ? apex.y * stress[2] : multiply_add(apex.y, stress[2], g[2]);
    g[0] = e == 0 ? g[3] : g[0] + g[3 + e];
  }
  g[1] = multiply_add(rest.q, second, multiply_add(rest.p, first, g[1]));
  g[2] = multiply_add(rest.r, second, g[2]);
  g[0] = -((g[1] + g[2]) + g[0]);
}

}  // namespace pd::inline PD_TARGET
