"""The simulator: a compiled scene as an `nn.Module` that steps states, tunes its solver and saves itself."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..accuracy.tuning_result import TuningResult
from ..common.checks import check_has_values
from ..common.synonyms import Renamed, no_attribute
from ..files.simulation_file import SavedSimulation, load_simulation, reading, save_simulation
from ..files.summary import describe
from ..plan.material import named_arrays
from ..plan.preconditioner import has_preconditioner, precondition_plan, stored_reference
from ..scene.solvers import Solver
from ..scene.targets import Targets
from ..simulation.cuda_graph import CapturedStep
from ..simulation.state import HistoryState, State
from ..simulation.stepper import Stepper

__all__ = ["Simulator", "Targets"]

_SETTINGS = ("time_step", "iterations", "solver", "dtype", "tolerance", "kernel", "batch", "adjoint")


class Simulator(Stepper):
    """Steps a scene by implicit Euler, each step solved approximately by projective dynamics.

    Material and effects are parameters, without gradient until you ask for one. Each is shared by all environments or,
    with a leading batch, has one value for each:

        stiffness      [E] Pa, Young's modulus          masses         [V] kg
        gravity        [3] m/s^2                        damping        [] 1/s
        pin_stiffness  [P] N/m                          pin_targets    [P, 3] m
        planes         [C, 5] normal, height, friction  spheres        [S, 8] centre, radius, friction, motion of a step
        pressure       [n] Pa, at the rest volume       wind           [3] m/s

    Scenes with cloth, rods, springs, ties, fibres or a Poisson's ratio have further arrays, see docs/materials.md.

    The buffer `pin_hard` [P] or [B, P] says which pins hold exactly; change it to release and to grasp. `set_material`
    checks and replaces all of these. The rest shape is compiled and has no gradient.

    A scene with `Contact` has the buffers `contact_friction` [Q, Q], of the bodies of the scene and then its colliders,
    and `contact_thickness` [1] m, on the CPU. Set a number, a tensor or a `torch.nn.Parameter`: tensors are kept, so
    that steps follow what an optimiser writes. Friction may also be [] or, for each environment, [B, 1, 1] or
    [B, Q, Q]. Setting the thickness finds the pairs that are closer than it at rest.

    A step checks no values, because that would wait for a GPU. Where an optimiser or `torch.func.functional_call`
    brings NaN, or negative stiffness, masses or springs, `Info.residual` is NaN (`Info` names the exceptions). So let
    an optimiser learn the logarithm of positive quantities.

    Guides: docs/quickstart.md, docs/materials.md, docs/solvers.md (solver, iterations, tolerance), docs/gpu.md.

    Args:
        scene: bodies and effects.
        time_step: h [s], positive.
        iterations: most local and global steps in a time step. None: 64, or the choice of "auto". An `UnsolvedWarning`
            comes once if the default number is expected to leave an error of 0.1 or more; `print(sim)` has the
            estimate.
        solver: `Chebyshev()` (None), `Jacobi()`, `Multilevel()`, `Newton()`, or one of their names in lower case.
            "auto" chooses a solver for an error of 1e-3, and if no iterations are given their limit and a tolerance:
            docs/solvers.md. May be set later.
        dtype: torch.float32 or torch.float64. A warning comes if float32 resolves rest positions more coarsely than
            1e-4 of an edge. Positions of later states are not checked.
        tolerance: an environment stops iterating when its estimated relative displacement error falls below this; 0:
            never, or the choice of "auto". Relative to the displacement that elasticity and contacts (or gravity, if
            more) cause: docs/limits.md.
        kernel: of a GPU: "block", "cluster", "grid" or "stream". "auto" takes the first that fits or, with `batch`, the
            one expected to be fastest. "benchmark" times each that fits. See docs/gpu.md. May be set later.
        batch: expected environments of a step, for which a GPU's plan, `Multilevel` and "auto" are chosen. Other
            batches run with the same bits, possibly slower. None: unknown. May be set later. No effect on the CPU.
        adjoint: preconditioner of gradients: "solver" has that of the solver, "multilevel" the matrix of `Multilevel`
            beside any solver (on a GPU with kernel="stream"): docs/solvers.md. May be set later.
        device: target of `.to(device)`, "cuda" for example. None: the CPU, whatever torch's default device.
        progress: show a bar while a large scene compiles, also for another device.
    """

    tuning_result: TuningResult | None
    promise = Renamed("tuning_result")
    numbers = Renamed("step_settings")

    def extra_repr(self) -> str:
        return describe(self, self.tuning_result)

    def __getattr__(self, name: str) -> Any:
        parameters = self.__dict__.get("_parameters", ())
        if name in parameters:
            return parameters[name]
        try:
            return super().__getattr__(name)
        except AttributeError as error:
            raise no_attribute("Simulator", name, self) from error

    def __repr__(self) -> str:
        return f"{type(self).__name__}(\n  {self.extra_repr()}\n)"

    def capture(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        return_info: bool = False,
    ) -> CapturedStep:
        """Record `step_` as a CUDA graph, which costs the host less to start: see `CapturedStep`.

        Args:
            state: every replay overwrites this state; recording leaves it unchanged.
            forces: as in `forward`; change them in place between replays.
            targets: as in `forward`; change them in place between replays.
            start: as in `forward`; positions may be changed in place between replays.
            return_info: fill in `CapturedStep.info`.
        """
        return CapturedStep(self, state, forces, targets, start, report=return_info)

    def tune(
        self,
        state: State | HistoryState | None = None,
        *,
        error: float | None = None,
        milliseconds: float | None = None,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        candidates: Sequence[Solver] | None = None,
        most: int = 2048,
        progress: bool = False,
    ) -> TuningResult:
        """Choose and set solver and iterations for an error or a time, from a short study on this scene.

        Sets `tolerance` to 0, so that no step stops early. Errors exclude 10 eps |x| of rounding, see `TuningResult`.

        The result is also kept in `self.tuning_result`, for the present material. Check steps of a run with
        `result.is_valid(info)`. If the target cannot be reached, the best setting is taken, with `attained=False` and a
        `TuningWarning`. Files do not keep the result, because times depend on the machine.

        The study solves nine steps of each studied environment to convergence, in float64 on the CPU. That takes about
        a second for a thousand vertices; docs/solvers.md has a table. Friction triples it at most; `Contact` takes ten
        times as long. Where steps with friction or `Contact` do not converge, as for stiff bodies that stick and slip,
        the target counts as not reached. Colliders stay where the state has them.

        Args:
            state: start of typical motions [B, V, 3]; by default the rest state, once for each environment of the
                material. At most four environments are studied, over 30 steps. Times are for the batch of this state.
            error: target of |x - x*| / |x_0 - x*| in (0, 1); x* is the converged step, x_0 = x + h v.
            milliseconds: target of `sim(state)` on this machine. The error is then the lowest for that time, with no
                more iterations than it takes to get below rounding.
            forces: on the vertices during these steps [B, V, 3] [N].
            targets: during these steps, as in `forward`; by default the places and activations of the scene.
            candidates: solvers to choose from, not "auto"; by default those that cannot diverge, with friction without
                `Multilevel` (docs/limits.md#multilevel-with-friction).
            most: upper bound of the iterations.
            progress: show a bar.

        Raises:
            ValueError: non-finite states, forces or material; a singular system; a scene without motion; targets of
                a `Collider`.
            RuntimeError: no converged step to compare with; solver and iterations stay.
        """
        from ..accuracy.tuning import tune  # imported here, because its baselines take 0.1 s to import

        return tune(
            self,
            state,
            error=error,
            milliseconds=milliseconds,
            forces=forces,
            targets=targets,
            candidates=candidates,
            most=most,
            progress=progress,
        )

    def save(self, path: str | Path) -> None:
        """Write scene, settings and material to one file: safetensors with JSON metadata, no pickle."""
        check_has_values("save", self.device)
        save_simulation(self._saved(), path)

    @staticmethod
    def load(path: str | Path) -> Simulator:
        """Read a file of `save` onto the CPU and compile its scene.

        All parts are new objects in their original order, and keys of `targets` and read-outs: `sim.scene.bodies`,
        `sim.scene.colliders`, `sim.scene.pins` and `sim.scene.spheres`.
        """
        saved = load_simulation(path)
        with reading(path):
            return _restored(saved)

    def _saved(self) -> SavedSimulation:
        material, contact = named_arrays(self), self._contact_tensors()
        return SavedSimulation(
            scene=self.scene,
            settings={name: getattr(self, name) for name in _SETTINGS},
            named_iterations=self.named_iterations,
            choice=self.choice,
            material=material,
            contact=contact,
            parameters=[name for name in contact if name in self._parameters],
            trained=[name for name, value in (material | contact).items() if value.requires_grad],
            reference=stored_reference(self.plan.arrays) if has_preconditioner(self.plan.arrays) else None,
        )


# Python's errors about arguments name the class that users know.
for _base in Simulator.__mro__[1:]:
    for _name, _method in vars(_base).items():
        if _base.__module__.startswith("torchpd.") and inspect.isfunction(_method):
            _method.__qualname__ = f"Simulator.{_name}"


_NONE = torch.zeros(0)


def _restored(saved: SavedSimulation) -> Simulator:
    sim = Simulator(saved.scene, **saved.settings)
    # files from before a flat scene left it out have its zeros
    flat = "rest_curvature" not in sim.material_names and not bool(saved.material.get("rest_curvature", _NONE).any())
    left_out = {"rest_curvature"} if flat else set()
    sim.set_material(**{name: array for name, array in saved.material.items() if name not in left_out})
    for name, value in saved.contact.items():
        setattr(sim, name, nn.Parameter(value, requires_grad=False) if name in saved.parameters else value)
    for name in set(saved.trained) - left_out:
        getattr(sim, name).requires_grad_()
    reference = saved.reference
    # the bits of a preconditioner follow from mesh, stiffness and inertia
    if reference is not None and not all(map(torch.equal, reference, stored_reference(sim.plan.arrays))):
        sim.plan = precondition_plan(sim.plan, sim.scene.values(), *reference)
    sim.choice = saved.choice
    sim.named_iterations = saved.named_iterations
    sim.check_iterations("Simulator.load")
    return sim
