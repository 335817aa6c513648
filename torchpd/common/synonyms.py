"""Names that users may try: those of other libraries, which errors answer with ours, and our former names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

from .warn import warn_user

__all__ = ["SYNONYMS", "Renamed", "check_arguments", "no_attribute"]

P = ParamSpec("P")
R = TypeVar("R")

_BATCH = "environments are the leading dimension of a state, sim.rest_state(n), and `batch` prepares for so many"
_FRICTION = "Coulomb's coefficient is `friction`"
_TIME_STEP = "the time step is `time_step` [s]"
_VERTICES = "positions are `vertices` [V, 3] in m"

# By owner ("" for the module): missing names, separated by blanks, and the answer.
SYNONYMS: dict[str, dict[str, str]] = {
    "": {
        "Body DeformableBody FEM FEMEntity SoftBody": "an elastic body is `Solid(mesh, youngs=..., density=...)`",
        "Garment Membrane Sheet Shell": "a sheet of triangles is `Cloth(surface, youngs=..., thickness=...)`",
        "Cable Rope Thread": "a line is `Rod(points, youngs=..., radius=...)`",
        "Spring": "`Springs(body, pairs, stiffness)` joins pairs of vertices",
        "Attach Sew Weld": "`Tie(body, vertices, other, stiffness=...)` holds vertices to points of another body",
        "Fiber Fibers Fibre Muscle Muscles": "muscles are `Fibres(solid, direction, stiffness)`",
        "Collision Collisions SelfCollision": "bodies touch each other and themselves by `Contact()`",
        "Obstacle RigidBody StaticMesh": "a rigid surface is `Collider(mesh)`",
        "Engine Env Environment Model Sim World": "`Simulator(scene)` steps a `Scene`",
        "Anchor Attachment Constraint Fixed FixedConstraint": "`Pin(solid, vertices)` holds vertices",
        "Floor GroundPlane HalfSpace Plane": "a plane is `Ground(height, normal, friction=...)`",
        "Ball": "a sphere is `Sphere(center, radius)`",
        "Mesh": "`TetMesh` is what bodies are made of, `TriMesh` a surface",
        "step": "`Simulator(scene)` is called: after = sim(state)",
        "reset": "`Simulator(scene).rest_state()` is where everything starts",
        "load": "`Simulator.load(path)` reads a simulation, `TetMesh.from_file(path)` a mesh",
    },
    "Solid": {
        "E modulus young young_modulus youngs_modulus": "Young's modulus is `youngs` [Pa]",
        "nu poisson_ratio poissons_ratio": "Poisson's ratio is `poisson`",
        "lam lame la mu stiffness": "the material is Young's modulus `youngs` [Pa] and Poisson's ratio `poisson`",
        "rho": "`density` is in kg/m^3",
        "mass masses": "mass follows from `density` [kg/m^3]; sim.set_material(masses=...) sets that of vertices",
        "damping": "damping is a part of the scene: Scene(solid, Damping(rate))",
        "friction": "friction belongs to colliders: Ground(friction=...)",
        "tets vertices": "the rest shape is `mesh`, a TetMesh(vertices, tets)",
    },
    "Pin": {
        "idx ids indices indexes nodes points verts": "`vertices` are numbers of vertices, or a mask",
        "k ke kp": "`stiffness` is in N/m, and None holds exactly",
        "position positions target targets": "a step takes targets: sim(state, targets={pin: positions})",
        "cloth mesh rod": "the body is `body`",
    },
    "Cloth": {
        "E modulus young young_modulus youngs_modulus": "Young's modulus is `youngs` [Pa]",
        "nu poisson_ratio poissons_ratio": "Poisson's ratio is `poisson`",
        "density mass rho": "mass is per area: `area_density` [kg/m^2], the density times the thickness",
        "bend bend_stiffness bending_stiffness kb": "the flexural rigidity is `bending` [N m]",
        "mesh triangles vertices": "the sheet is `surface`, a TriMesh(vertices, triangles)",
        "uv uvs": "the rest shape by UVs is `rest_uv` [F, 3, 2] m",
    },
    "Rod": {
        "E modulus young young_modulus youngs_modulus": "Young's modulus is `youngs` [Pa]",
        "points vertices": "the vertices in order are `polyline` [N, 3]",
        "r thickness": "`radius` is in m",
    },
    "Springs": {"k ke": "`stiffness` is in N/m", "L L0 length": "the `rest_length` is in m"},
    "Tie": {"k ke": "`stiffness` is in N/m", "target targets": "`points` [N, 3] lie on the other body at rest"},
    "Fibres": {
        "body mesh": "the body is `solid`",
        "w": "`stiffness` is in Pa",
        "length": "L is 1 - `contraction` `activation`",
    },
    "Ground": {
        "mu friction_coefficient": _FRICTION,
        "level offset y z": "the plane is where normal . x is `height` [m]",
        "up": "`normal` points to the free side",
    },
    "Sphere": {"centre pos position": "the middle is `center` [3] in m", "r": "`radius` is in m", "mu": _FRICTION},
    "Collider": {
        "position rotation transform": "`pose` is (x, y, z, qw, qx, qy, qz)",
        "surface triangles vertices": "the surface is `mesh`, a TriMesh(vertices, triangles)",
        "mu": _FRICTION,
    },
    "Contact": {
        "gap margin offset r radius": "surfaces rest `thickness` apart [m]",
        "self_collision self_collisions": "whether bodies touch themselves is `self_contact`",
        "max_contacts": "`capacity` is the most pairs of an environment",
        "mu": _FRICTION,
    },
    "Pressure": {
        "p p0 pressure": "the overpressure is `pascals`",
        "cloth solid": "what it pushes is `body`",
        "faces surface": "the surface of the gas is `triangles` [F, 3]",
    },
    "Wind": {
        "speed v wind": "the velocity of the wind is `velocity` [3] in m/s",
        "Cd c coefficient drag_coefficient": "the coefficient is `drag`",
        "rho": "`density` is that of the air [kg/m^3]",
    },
    "Gravity": {"acceleration g value": "the acceleration is `vector` [3] in m/s^2"},
    "Damping": {"coefficient damping": "the drag is `rate` [1/s]"},
    "Scene": {
        "bodies gravity ground objects parts pins": "parts come one by one: Scene(Solid(...), Ground(), Gravity())",
        "dt time_step": "the time step belongs to `Simulator(scene, time_step=...)`",
    },
    "TetMesh": {"points verts": _VERTICES, "cells elements tetrahedra tetras": "elements are `tets` [E, 4]"},
    "TriMesh": {"points verts": _VERTICES, "faces": "faces are `triangles` [T, 3]"},
    "tetrahedralize": {
        "res resolution": "`cells` is how many cells the longest side has",
        "edge_length size spacing": "`cells` is the longest side divided by that length",
        "mesh": "what is filled is `surface`",
    },
    "Simulator": {
        "dt h step_size timestep": _TIME_STEP,
        "batch_size n_envs num_envs num_worlds nworld": _BATCH,
        "iters max_iter max_iterations n_iterations num_iterations": "`iterations` are those of a time step",
        "tol": "`tolerance` ends a step by its estimated error",
        "n_substeps num_substeps substeps": "there are no substeps: divide `time_step` by their number",
        "gravity ground": "gravity and grounds are parts of the scene: Scene(solid, Ground(), Gravity())",
        "step": "the simulator is called: after = sim(state); sim.step_(state) overwrites the state",
        "reset": "sim.rest_state() gives the start, and state.where(kept, start) resets some environments",
        "run simulate": "sim.rollout(state, steps) takes many steps",
        "initial_state": "sim.rest_state() gives the start",
        "state": "the simulator keeps no state: after = sim(state), from sim.rest_state() on",
    },
    "Simulator.rest_state": {"batch_size n n_envs num_envs": "`batch` is the number of environments"},
    "Simulator.rollout": {
        "T horizon n_steps num_steps": "`steps` is their number",
        "action actions control controls": "what acts from outside is `forces` and `targets`",
    },
}


def _answer(owner: str, name: str) -> str:
    return next((answer for names, answer in SYNONYMS.get(owner, {}).items() if name in names.split()), "")


def no_attribute(owner: str, name: str, value: object = None) -> AttributeError:
    """The error about a missing attribute of a class or ("") of the module."""
    answer = _answer(owner, name)
    words = f"{owner or 'torchpd'} has no attribute {name!r}{'; ' if answer else ''}{answer}"
    return AttributeError(words, name=name, obj=value)


class Renamed:
    """The former name of an attribute or method: works as the new one, with a `DeprecationWarning` that names it.

    Example:
        >>> class TuningResult:
        ...     holds = Renamed("is_valid")
    """

    def __init__(self, now: str) -> None:
        self.now = now

    def __set_name__(self, owner: type, name: str) -> None:
        self.former = f"{owner.__name__}.{name}"

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            return self
        self._warn()
        return getattr(instance, self.now)

    def __set__(self, instance: Any, value: Any) -> None:
        self._warn()
        setattr(instance, self.now, value)

    def _warn(self) -> None:
        warn_user(
            f"{self.former} is now called {self.now}: use that, the former name will be removed", DeprecationWarning
        )


def check_arguments(
    owner: str, *, renamed: Mapping[str, str] | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function known to users as `owner`, so that errors about arguments name it and its arguments.

    `renamed` maps former names of arguments to those of now; they work, with a `DeprecationWarning`.
    """
    former = renamed or {}

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        known = [name for name, one in signature(function).parameters.items() if one.kind != one.VAR_POSITIONAL]
        # Python's own errors about arguments use this name
        function.__qualname__ = owner + ".__init__" * (function.__name__ == "__init__")

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in list(kwargs):
                if name in former and former[name] not in kwargs:
                    warn_user(f"{owner}: {name} is now called {former[name]}: use that name", DeprecationWarning)
                    kwargs[former[name]] = kwargs.pop(name)
                elif name not in known:
                    ours = ", ".join(name for name in known if name != "self")
                    raise TypeError(f"{owner} has no argument {name!r}; {_answer(owner, name) or f'it takes {ours}'}")
            return function(*args, **kwargs)

        return checked

    return decorate
