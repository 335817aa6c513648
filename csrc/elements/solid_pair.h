// Elastic solids by faces: one tetrahedron, or two that share the face of corners 0, 1 and 2, with apexes after them.
//
// Rest shapes are given in a frame of the face: the first axis along the edge from corner 0 to corner 1, the third
// normal to the face. There Dm^-1 is upper triangular, and both tetrahedra share all but its last column:
//
//   F = Ds Dm^-1 = [p e_1,  q e_1 + r e_2,  s e_1 + t e_2 + h e_3],   e_c = x_c - x_0,
//
// with p, q, r of the face and s, t, h of a tetrahedron. For the rotation Q into the frame, F Q^T replaces the F of
// elements/solid.h and R Q^T its R, so energies and forces are the same. The shared columns are computed once. That
// saves a GPU a sixth of the instructions (tools/instructions.py), and a tetrahedron alone a thirtieth.
#pragma once
#include "elements/corotated.h"
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

// An effect that implements run_face, for one tetrahedron or two.
template <class Effect>
concept OnFaces = requires { requires Effect::on_faces; };

// An effect that reads rest shapes and weights alone.
template <class Effect>
concept ReadsWeightsAlone = requires { Effect::weights_alone; };

template <class R, int Count>
struct FaceRest {
  R p, q, r;            // [1/m]
  Vec3<R> apex[Count];  // s, t, h of each tetrahedron [1/m]

  // Dm^-1 of one tetrahedron
  PD_HD Mat3<R> inverse(int which) const {
    const R none(scalar_of<R>(0));
    const Vec3<R>& a = apex[which];
    return {{{p, q, a.x}, {none, r, a.y}, {none, none, a.z}}};
  }
};

// The rest shape from edges that start at corner 0, in any unit: `per_unit` units make a metre, `per_determinant` is
// unit^2 / det Dm of each tetrahedron. In float32 edges are whole numbers up to 2^31: all squares and their inverses
// fit, and a face that collapses in these units gives finite numbers.
//
// s and t are -h times the apex's position above the face, in the coordinates of its corners. Their error equals a
// few roundings of the apex times |e_1||e_2| / |e_1 x e_2|. h is exact to its bits, however flat the tetrahedron.
template <class R, int Count>
PD_HD FaceRest<R, Count> face_rest(const Vec3<R> (&edge)[2 + Count], const R& per_unit,
                                   const R (&per_determinant)[Count]) {
  using T = scalar_of<R>;
  const R least(sizeof(T) == 4 ? T(1) : smallest<T>());
  const auto at_least = [&](const R& a) { return select(a < least, least, a); };
  const Vec3<R>&first = edge[0], &second = edge[1];
  const Vec3<R> normal = exact_cross(first, second), ahead = cross(normal, first);
  const R length2 = at_least(dot(first, first)), normal2 = at_least(dot(normal, normal));
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

// The frame of a face at rest, before its tetrahedra are known: its first two axes. An apex has the coordinates a_1,
// a_2 and 1 / h there. Then
//
//   f_3 = h ((x_3 - x_0) - a_1 f_1 - a_2 f_2)
//
// needs only f_1 and f_2 of the edges, which frees registers.
template <class R>
struct FaceFrame {
  R p, q, r;         // [1/m], see above
  Vec3<R> one, two;  // axes, times the metres of a unit of edges
  R height;          // h is that times unit^2 / det Dm

  // see face_rest
  PD_HD FaceFrame(const Vec3<R> (&edge)[2], const R& unit) {
    using T = scalar_of<R>;
    const R least(sizeof(T) == 4 ? T(1) : smallest<T>());
    const auto at_least = [&](const R& a) { return select(a < least, least, a); };
    const Vec3<R> normal = exact_cross(edge[0], edge[1]);
    const R length2 = at_least(dot(edge[0], edge[0])), normal2 = at_least(dot(normal, normal));
    const R per_unit = reciprocal(unit), per_length2 = reciprocal(length2);
    const R per_length = rough_square_root(per_length2), share = unit * per_length;
    height = rough_square_root(normal2);
    const R per_height = reciprocal(height);
    p = per_unit * per_length;
    r = per_unit * (length2 * per_length) * per_height;
    q = -(dot(edge[0], edge[1]) * per_length2) * r;
    one = share * edge[0];
    two = (share * per_height) * cross(normal, edge[0]);
  }
};

// The columns f_1 and f_2, which all deformation gradients of a face share, and the third column of their cofactors.
template <class R>
struct FaceColumns {
  Vec3<R> first, second, normal;        // normal = f_1 x f_2
  R first2, second2, between, normal2;  // |f_1|^2, |f_2|^2, f_1.f_2, |normal|^2

  PD_HD FaceColumns(const Vec3<R>& first, const Vec3<R>& second)
      : first(first),
        second(second),
        normal(cross(first, second)),
        first2(dot(first, first)),
        second2(dot(second, second)),
        between(dot(first, second)),
        normal2(dot(normal, normal)) {}

  // `Rest`: FaceRest or FaceFrame
  template <class Rest>
  PD_HD FaceColumns(const Vec3<R> (&edge)[2], const Rest& rest)
      : FaceColumns(rest.p * edge[0], multiply_add(rest.r, edge[1], rest.q * edge[0])) {}

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

// Gradient on all corners. With `Energy` and `wanted` the strains are computed with weight one, and their energies
// added to `energy`. The tetrahedra are processed one after the other, which takes the fewest registers.
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
  Vec3<R> first, second;  // summed stress columns of all tetrahedra
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    const Invariants<R> i = face.invariants(third[e]);
    Vec3<R> stress[3];
    const bool strains = Energy && wanted;
    finish_columns(face, third[e], i, largest_root(i), strains ? R(scalar_of<R>(1)) : weight[e],
                   stress);
    if (strains) {
      const R square =
          (dot(stress[0], stress[0]) + dot(stress[1], stress[1])) + dot(stress[2], stress[2]);
      energy = multiply_add(R(scalar_of<R>(0.5)) * weight[e], square, energy);
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

// The same with Poisson's ratio, see elements/corotated.h; `weight` is V 2 mu, `pressure` V lambda. `alone`: each
// tetrahedron has its own trace; else all of them average it, with those of other `lanes`.
template <bool Energy, class R, int Count, class Lanes>
PD_HD void corotated_face_gradient(const Vec3<R> (&x)[3 + Count], const FaceRest<R, Count>& rest,
                                   const R (&weight)[Count], const R (&pressure)[Count], bool alone,
                                   const Lanes& lanes, bool wanted, Vec3<R> (&g)[3 + Count],
                                   R& energy) {
  const R half(scalar_of<R>(0.5));
  const Vec3<R> edge[2] = {x[1] - x[0], x[2] - x[0]};
  const FaceColumns<R> face(edge, rest);
  Vec3<R> third[Count], strain[Count][3];
  R trace[Count], slope[Count], tension_energy[Count];
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    third[e] =
        multiply_add(apex.z, x[3 + e] - x[0], multiply_add(apex.y, edge[1], apex.x * edge[0]));
    const Invariants<R> i = face.invariants(third[e]);
    finish_columns(face, third[e], i, largest_root(i), R(scalar_of<R>(1)), strain[e]);
    trace[e] = (dot(face.first - strain[e][0], strain[e][0]) +
                dot(face.second - strain[e][1], strain[e][1])) +
               dot(third[e] - strain[e][2], strain[e][2]);
  }
  if (alone) {
    for (int e = 0; e < Count; ++e) {
      const GroupTension<R> tension({trace[e]}, {weight[e]}, {pressure[e]});
      slope[e] = tension.slope;
      if (Energy) tension_energy[e] = tension.energy();
    }
  } else {
    const GroupTension<R> tension(trace, weight, pressure, lanes);
    for (int e = 0; e < Count; ++e) {
      slope[e] = tension.slope;
      if (Energy) tension_energy[e] = tension.energy();
    }
  }
  Vec3<R> first, second;
  for (int e = 0; e < Count; ++e) {
    const Vec3<R>& apex = rest.apex[e];
    if (Energy && wanted) {
      const R square = (dot(strain[e][0], strain[e][0]) + dot(strain[e][1], strain[e][1])) +
                       dot(strain[e][2], strain[e][2]);
      energy = multiply_add(half * weight[e], square,
                            multiply_add(pressure[e], tension_energy[e], energy));
    }
    const R pull = pressure[e] * slope[e], left = weight[e] - pull;
    const Vec3<R> stress[3] = {multiply_add(pull, face.first, left * strain[e][0]),
                               multiply_add(pull, face.second, left * strain[e][1]),
                               multiply_add(pull, third[e], left * strain[e][2])};
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

// The same for two tetrahedra without it, with corners loaded when needed and forces stored when known. load(corner, position,
// rest) gives rest positions in any `unit` [m]; store(corner, force) takes forces. `factor` is unit^2 / det Dm of
// each. between() runs after the first tetrahedron, where the fewest registers are in use.
template <bool Energy, class Rest, class R, class Load, class Store, class Between>
PD_HD void solid_pair_gradient(const R (&factor)[2], const R (&weight)[2], const R& unit, R& energy,
                               const Load& load, const Store& store, const Between& between) {
  Vec3<R> x[3];
  Rest rest[3];
  for (int c = 0; c < 3; ++c) load(c, x[c], rest[c]);
  const FaceFrame<R> frame({rest[1] - rest[0], rest[2] - rest[0]}, unit);
  const FaceColumns<R> face({x[1] - x[0], x[2] - x[0]}, frame);
  Vec3<R> first, second, apexes;  // sums over the tetrahedra, for the face's corners
  for (int e = 0; e < 2; ++e) {
    Vec3<R> apex;
    Rest apex_rest;
    load(3 + e, apex, apex_rest);
    const Vec3<R> place = apex_rest - rest[0];
    const R h = frame.height * factor[e];
    const R one = dot(frame.one, place), two = dot(frame.two, place);
    const Vec3<R> third =
        h * subtract_product(subtract_product(apex - x[0], one, face.first), two, face.second);
    const Invariants<R> i = face.invariants(third);
    Vec3<R> stress[3];
    finish_columns(face, third, i, largest_root(i), Energy ? R(scalar_of<R>(1)) : weight[e],
                   stress);
    if (Energy) {
      const R square =
          (dot(stress[0], stress[0]) + dot(stress[1], stress[1])) + dot(stress[2], stress[2]);
      energy = multiply_add(R(scalar_of<R>(0.5)) * weight[e], square, energy);
      for (Vec3<R>& column : stress) column = weight[e] * column;
    }
    const Vec3<R> force = h * stress[2];
    store(3 + e, force);
    const Vec3<R> along = subtract_product(stress[0], one, force);
    const Vec3<R> across = subtract_product(stress[1], two, force);
    first = e == 0 ? along : first + along;
    second = e == 0 ? across : second + across;
    apexes = e == 0 ? force : apexes + force;
    if (e == 0) between();
  }
  const Vec3<R> g1 = multiply_add(frame.q, second, frame.p * first), g2 = frame.r * second;
  store(0, -((g1 + g2) + apexes));
  store(1, g1);
  store(2, g2);
}

}  // namespace pd::inline PD_TARGET
