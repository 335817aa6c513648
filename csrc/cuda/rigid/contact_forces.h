// The coarse correction of a vertex (solver/coarse), and the contact forces that it keeps in device memory.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/vertices.h"
#include "solver/coarse/newton.h"
#include "views/arena.h"

namespace pd::inline PD_TARGET {

// The iterate that a correction begins from: the last one, or before any iteration one of the two
// first ones. The present shape is corrected first, if a piece is solid, and then the guess. Of a solid
// piece the one of less energy stays.
enum class Iterate : int { last, present, guess };

// The second correction of a step's start (`first`), the only one of its end, or that before.
PD_DEVICE Iterate iterate_of(int n, bool first) {
  if (n == 0) return Iterate::present;
  return first ? Iterate::guess : Iterate::last;
}

// Reads past the L1 cache, which may not hold the writes of other blocks.
PD_DEVICE Vec3<double> read_vector(const Quad<float>* from) {
  const float4 f = __ldcg(reinterpret_cast<const float4*>(from));
  return {f.x, f.y, f.z};
}
PD_DEVICE Vec3<double> read_vector(const Quad<double>* from) {
  const double2 f = __ldcg(reinterpret_cast<const double2*>(from));
  return {f.x, f.y, __ldcg(&from->z)};
}

// ContactForce of every contact of one vertex, in double.
template <class T>
struct VertexForces {
  Quad<T>* first;
  int vertices;

  PD_DEVICE Quad<T>* of(int n) const { return first + std::int64_t(n) * vertices; }
  PD_DEVICE Vec3<double> force(int n) const { return read_vector(of(n)); }
  PD_DEVICE double radius(int n) const { return double(__ldcg(&of(n)->w)); }
  PD_DEVICE void set_radius(int n, double radius) const { of(n)->w = T(radius); }
  PD_DEVICE void set(int n, const Vec3<double>& force, double radius) const {
    *of(n) = {T(force.x), T(force.y), T(force.z), T(radius)};
  }
};

// By vertex, not by slot: copies of a shared vertex read what its owner writes.
template <class T>
struct ContactForces {
  Quad<T>* force;  // [environments, contacts, vertices], w = radius of friction
  // [environments, vertices]: of the mean elastic force, from the present shape to the guess, and what
  // Phi has more than the energy
  T* work;
  int contacts, vertices;

  PD_DEVICE ContactForces of_environment(std::int64_t environment) const {
    const std::int64_t first = environment * vertices;
    return {force + first * contacts, work + first, contacts, vertices};
  }
  PD_DEVICE VertexForces<T> at(int vertex) const { return {force + vertex, vertices}; }
};

// Only where pins leave pieces free.
template <class T>
ContactForces<T> arrange_contact_forces(Arena& arena, const DeviceStep<T>& step,
                                        std::int64_t environments) {
  const std::int64_t count = has_free_pieces(step) ? environments * step.plan.vertices : 0;
  ContactForces<T> forces;
  forces.contacts = step.material.planes_count + step.material.spheres_count;
  forces.vertices = step.plan.vertices;
  arena.place(forces.force, count * forces.contacts);
  arena.place(forces.work, count);
  return forces;
}

template <class T, bool HasContacts>
PD_DEVICE CoarseVertex<double> coarse_vertex(const Vertex<Thread<T>, HasContacts>& vertex,
                                             const Vec3<T>& u) {
  return {widened<double>(vertex.x), widened<double>(u), double(vertex.inverse)};
}

// A correction of the vertices of one environment. `i`: place of a vertex in `v`, `vertex`: its number.
template <class T, bool HasContacts>
struct Correction {
  Vertices<T, HasContacts> v;
  Contacts<T> contacts;
  Inputs<T> in;
  ContactForces<T> forces;
  Iterate from;

  PD_DEVICE Vec3<T> present(int i) const { return v.at(i).current_iterate(contacts); }
  PD_DEVICE Vec3<T> guess(int i, int vertex) const { return v.first(i, in, vertex, contacts); }

  // Keeps the forces with which contacts answer the gradient of E at u, or at the present shape the elastic force
  // alone. Adds up the work.
  PD_DEVICE void keep_forces(int i, int vertex, const Vec3<T>& elastic) const {
    const Vec3<double> force = widened<double>(elastic);
    const Vec3<double> way = widened<double>(guess(i, vertex)) - widened<double>(present(i));
    double work = 0.5 * dot(force, way);
    if constexpr (HasContacts) {
      const auto at = v.at(i);
      const CoarseVertex<double> coarse = coarse_vertex(at, vec3(v.u[i]));
      const Vec3<double> offset = coarse.u - widened<double>(at.target);
      const double inertia = from == Iterate::present ? 0.0 : double(at.inertia);
      const Vec3<double> gradient = multiply_add(inertia, offset, force);
      const Vec3<double> free = subtract_product(coarse.u, double(at.inverse), gradient);
      pd::keep_forces(contacts, coarse, free, forces.at(vertex));
      if (from == Iterate::last) return;
      const double anchor = anchor_energy(contacts, coarse, forces.at(vertex));
      work = multiply_add(from == Iterate::present ? 1.0 : -1.0, anchor, work);
    }
    T* const to = forces.work + vertex;
    *to = from == Iterate::present ? T(work) : __ldcg(to) + T(work);
  }

  // The vertex moved with its body, and then by what the contacts still push. After the present
  // shape comes the guess.
  PD_DEVICE_COLD Vec3<T> corrected(int i, int vertex, const CoarseBody& body) const {
    Vec3<T> u = vec3(v.u[i]);
    if (body.moves()) {
      const auto narrowed = [](const Vec3<double>& a) { return Vec3<T>{T(a.x), T(a.y), T(a.z)}; };
      const auto at = v.at(i);
      CoarseVertex<double> coarse = coarse_vertex(at, u);
      u = at.displaced(u, narrowed(body.motion().of(coarse.x + coarse.u)));
      if constexpr (HasContacts) {
        coarse.u = widened<double>(u);
        u = at.displaced(u, narrowed(push_of(contacts, coarse, forces.at(vertex))));
        u = at.project(contacts, u, u);
      }
    }
    if (from != Iterate::present) return u;
    v.set_before(i, u);
    return guess(i, vertex);
  }

  // Of its energy, from the present shape to the guess. `kept`, `moved`: motions of its piece.
  PD_DEVICE double rise_of(int i, int vertex, const RigidMotion<double>& kept,
                           const RigidMotion<double>& moved) const {
    const auto wide = [](const Vec3<T>& a) { return widened<double>(a); };
    const Candidate<double> before = {wide(present(i)), wide(vec3(v.before[i])), kept};
    const Candidate<double> after = {wide(guess(i, vertex)), wide(vec3(v.u[i])), moved};
    return double(__ldcg(forces.work + vertex)) +
           pd::rise_of<HasContacts>(double(v.inertia(i)), wide(vec3(v.x[i])),
                                    wide(vec3(v.target[i])), before, after);
  }

  // The first iterate, also the previous one of the first iteration. A piece that pins clamp takes the guess.
  PD_DEVICE Vec3<T> chosen(int i, const CoarseBody& body, double rise) const {
    const bool stays = body.moves() && !(rise < 0);
    const Vec3<T> u = vec3(stays ? v.before[i] : v.u[i]);
    v.set_before(i, u);
    return u;
  }
};

}  // namespace pd::inline PD_TARGET
