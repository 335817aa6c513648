// Vertex state in device memory, and the update of one vertex.
#pragma once
#include "cuda/common/inputs.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts>
struct Vertices {
  Quad<T>*x, *velocity, *target;  // at the start of the step: [m], [m/s]; s [m] with w = a
  Quad<T>*u, *before;             // iterate and previous iterate [m]; w = 1 / D

  // The state of a vertex, loaded before its elastic force is known.
  struct LoadedVertex {
    Vertex<Thread<T>, HasContacts> vertex;
    Vec3<T> u, before;

    PD_DEVICE double energy() const {
      const Vec3<T> none = {T(0), T(0), T(0)}, twice = vertex.add_energy(u, none);
      return 0.5 * double((twice.x + twice.y) + twice.z);
    }

    // |u - s|^2, the squared displacement that the tolerance is relative to
    PD_DEVICE double square_of_displacement() const {
      const Vec3<T> displacement = u - vertex.target;
      return double(dot(displacement, displacement));
    }

    PD_DEVICE Vec3<T> next(const Contacts<T>& contacts, const Vec3<T>& force, T theta,
                           T omega) const {
      return vertex.next(contacts, u, before, force, theta, omega);
    }
  };

  PD_DEVICE LoadedVertex load(unsigned i) const { return {at(i), vec3(u[i]), vec3(before[i])}; }

  PD_DEVICE Vertex<Thread<T>, HasContacts> at(unsigned i) const {
    return {vec3(x[i]), vec3(target[i]), inertia(i), u[i].w};
  }

  PD_DEVICE T inertia(unsigned i) const { return target[i].w; }

  PD_DEVICE void init(int i, const Inputs<T>& in, int vertex, T h) const {
    x[i] = quad(in.at_vertex(in.call->positions, vertex));
    velocity[i] = quad(in.at_vertex(in.call->velocities, vertex));
    target[i] = {T(0), T(0), T(0), in.inertia(vertex, h)};
    u[i] = before[i] = {T(0), T(0), T(0), T(0)};
  }

  // Stores 1 / D and returns inertia_ratio.
  PD_DEVICE double set_diagonal(int i, T elastic) const {
    const T a = inertia(i), inverse = inverse_diagonal(a, elastic);
    u[i].w = before[i].w = inverse;
    return double(inertia_ratio(a, elastic, inverse));
  }

  PD_DEVICE void predict(int i, const Inputs<T>& in, int vertex, T h) const {
    target[i] = quad(in.target(vertex, vec3(x[i]), vec3(velocity[i]), h), inertia(i));
  }

  PD_DEVICE Vec3<T> at_constant_velocity(int i, T h) const { return h * vec3(velocity[i]); }

  // The predicted first iterate, used unless the caller gives one.
  PD_DEVICE Vec3<T> predicted(int i, const Settings& settings) const {
    if (settings.start() == StartKind::inertial) return vec3(target[i]);
    return at_constant_velocity(i, T(settings.time_step));
  }

  PD_DEVICE Vec3<T> first(int i, const Inputs<T>& in, int vertex,
                          const Contacts<T>& contacts) const {
    const Settings& settings = in.call->settings;
    const bool given = settings.start() == StartKind::given;
    return at(i).first_iterate(
        contacts, given ? in.first_iterate(vertex) - vec3(x[i]) : predicted(i, settings));
  }

  PD_DEVICE void set(unsigned i, const Vec3<T>& value) const { u[i] = quad(value, u[i].w); }
  PD_DEVICE void set_before(unsigned i, const Vec3<T>& value) const {
    before[i] = quad(value, before[i].w);
  }
  // Overwrites the previous iterate; the caller then swaps the two arrays.
  PD_DEVICE void set_in_place_of_before(unsigned i, const LoadedVertex& loaded,
                                        const Vec3<T>& value) const {
    before[i] = quad(value, loaded.vertex.inverse);
  }

  PD_DEVICE void finish(int i, T h) const {
    const Vec3<T> moved = vec3(u[i]);
    x[i] = quad(vec3(x[i]) + moved);
    velocity[i] = quad((T(1) / h) * moved);
  }
};

}  // namespace pd::inline PD_TARGET
