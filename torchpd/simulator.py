"""The simulator: a compiled scene as an `nn.Module` that steps states, tunes and saves itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .capture import CapturedStep
from .checks import check_has_values
from .io import SavedSimulation, load_simulation, reading, save_simulation
from .material import named_arrays
from .multilevel import has_levels, precondition_plan, reference_of_levels
from .promise import TuningResult
from .solvers import Solver
from .state import State
from .stepper import Stepper
from .summary import describe
from .synonyms import Renamed, no_attribute
from .targets import Targets

__all__ = ["Simulator", "Targets"]

_SETTINGS = ("time_step", "iterations", "solver", "dtype", "tolerance", "kernel", "batch", "adjoint")


class Simulator(Stepper):
    """Steps a scene through time by implicit Euler, solved approximately by projective dynamics.

    The values that training may change are parameters (without gradient until asked), for all environments or, with a
    leading batch, for each: `stiffness` [E] Pa, `masses` [V] kg, `gravity` [3] m/s^2, `damping` [] 1/s,
    `pin_stiffness` [P] N/m, `pin_targets` [P, 3] m, `planes` [C, 5] (unit normal, height, friction), `spheres` [S, 8]
    (centre, radius, friction, motion in a step). The buffer `pin_hard` [P] or [B, P] says which pins hold exactly; it
    may change at run time, to let go and to grasp. `set_material` checks and replaces all of them. Steps do
    not check what an optimiser writes or `torch.func.functional_call` gives, as that would wait for a GPU. Where it is
    NaN, or stiffness, masses or springs are negative, `Info.residual` is NaN, with exceptions named there. Let an
    optimiser learn the logarithm of those. The rest shape is compiled and not learned.

    It is made on the CPU, whatever torch's default device, unless `device` says otherwise; `.to(...)` moves it.

    Args:
        scene: what there is.
        time_step: h [s], positive.
        iterations: local and global steps of one time step, at most. None: 64, or what "auto" chooses. Where 64 are
            expected to leave a tenth of the error or more an `UnsolvedWarning` says so, once, also when `set_material`,
            `load_state_dict` or another `time_step` has brought that about; `print(sim)` tells for any.
        solver: `Chebyshev()`, `Jacobi()` or `Multilevel()`, or "chebyshev", "jacobi" or "multilevel" for these without
            options; `sim.solver` may be replaced later. None is Chebyshev.
            "auto" takes Chebyshev or Multilevel, whichever is expected to reach an error of 1e-3 sooner on the device,
            Chebyshev where there is friction, and as many iterations as that takes unless they are given, four times as
            many where a `tolerance` ends easy steps, but no more than 10,000, and 1000 of Multilevel, times four with a
            tolerance; `print(sim)` says why, an `UnsolvedWarning` where that will not do. It chooses anew when the
            simulator moves to another device, for another `kernel` or `batch`, and in `prepare_solver`, which an
            `UnsolvedWarning` asks for where a change of material or time step makes the old choice leave 1e-2 or more.
        dtype: precision, torch.float32 or torch.float64. A warning tells where float32 resolves rest positions to more
            than 1e-4 of an edge. States that lie farther from the origin are not looked at, which would wait for a GPU.
        tolerance: an environment stops iterating when |x - x*| is about tolerance |x - s| or less, s being where
            inertia, forces and springs alone would take the vertices, so that |x - s| is what elasticity and contacts
            do, or what gravity does if that is more; 0 never. The error is judged by the changes of iterations and by
            how slow the slowest mode can be, from the weights of the step: see docs/limits.md.
        kernel: how a GPU is to step the scene after `.to("cuda")`: "block", "cluster", "grid" or "stream", see
            `torchpd.regimes`; "auto" takes the first that fits, and with `batch` the one expected to be the quickest.
            "benchmark" times a few steps of each that fits, once a process, GPU and size. `sim.kernel` may be set
            later. Changes nothing on the CPU.
        batch: environments that a step will have, where you know it: a GPU's kernel, its patches and thread blocks, the
            patches and preconditioner of `Multilevel` and the choice of "auto" are for so many. States of any batch may
            come, and an environment has the same bits in all of them, but takes longer in some; thread blocks of the
            smallest meshes in float32 are for the batch that comes. None: not known: a small mesh gets "block", which
            is for many, and "auto" chooses for one. `sim.batch` may be set later. Changes nothing on the CPU.
        adjoint: what preconditions the linear system of a gradient. "solver": what the solver has, a diagonal or the
            matrix of `Multilevel`. "multilevel": that matrix beside any solver, made when it is set; docs/accuracy.md
            says when it pays. A GPU needs kernel="stream" for it. `sim.adjoint` may be set later.
        device: what `.to(device)` would take, "cuda" for example. None: the CPU.
        progress: show a bar while a large scene compiles, for another device too.
    """

    tuning_result: TuningResult | None
    promise = Renamed("tuning_result")

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
        """Record `step_` as a CUDA graph, which starts with less work for the host: see `CapturedStep`.

        Args:
            state: what every replay moves on; recording leaves it as it is.
            forces: as in `forward`; change them in place between replays.
            targets: as in `forward`; change them in place between replays.
            start: as in `forward`; positions may be changed in place between replays.
            return_info: fill in `CapturedStep.info`.
        """
        return CapturedStep(self, state, forces, targets, start, report=return_info)

    def tune(
        self,
        state: State | None = None,
        *,
        error: float | None = None,
        milliseconds: float | None = None,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        candidates: Sequence[Solver] | None = None,
        most: int = 2048,
        progress: bool = False,
    ) -> TuningResult:
        """Choose solver and iterations for an error or a time, from a short study on this scene; sets them.

        No step stops early then: `tolerance` becomes 0. Errors leave out 10 eps |x| of rounding, see `TuningResult`.

        The result is also kept in `self.tuning_result`, for the present material. Check steps of a run with
        `result.is_valid(info)`. If the target cannot be reached, the best setting is taken, with `attained=False` and a
        `TuningWarning`. Files do not keep the result, because times depend on the machine.

        Takes about a second for a thousand vertices, 2 to 8 s for 3 thousand and 20 s for 10 thousand on one core of a
        CPU: nine steps of each studied environment are solved to convergence in float64, on the CPU. With friction up
        to three times as long; where steps come to no end there, as of stiff bodies that stick and slip, the target
        counts as out of reach.

        Args:
            state: where typical motions start [B, V, 3], the rest state by default, once for each environment of the
                material; up to four environments are studied over 30 steps. Times are for its batch.
            error: of a step, |x - x*| / |x_0 - x*|, x* converged and x_0 = x + h v; in (0, 1).
            milliseconds: of `sim(state)` on this machine; the error is then as low as that allows, with no more
                iterations than it takes to get below rounding.
            forces: on the vertices during these steps [B, V, 3] [N].
            targets: where pins and spheres are during them, as in `forward`; by default where the scene has them.
            candidates: solvers to choose from, not "auto"; by default those that cannot diverge, and no `Multilevel`
                where there is friction, which may lead it astray in steps that the study has not seen.
            most: iterations of a step, at most.
            progress: show a bar.

        Raises:
            ValueError: states, forces or material that are not finite, a singular system, a scene without motion.
            RuntimeError: no converged step to compare with; solver and iterations stay.
        """
        from .tuning import tune  # its methods of comparison take a tenth of a second to import

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
        """Read what `save` wrote, on the CPU. The scene is compiled anew.

        Pins and spheres are new objects, `sim.scene.pins` and `sim.scene.spheres`, in the order in which they were
        given.
        """
        saved = load_simulation(path)
        with reading(path):
            return _restored(saved)

    def _saved(self) -> SavedSimulation:
        material = named_arrays(self)
        return SavedSimulation(
            scene=self.scene,
            settings={name: getattr(self, name) for name in _SETTINGS},
            named_iterations=self.named_iterations,
            choice=self.choice,
            material=material,
            trained=[name for name, value in material.items() if value.requires_grad],
            reference=reference_of_levels(self.plan.arrays) if has_levels(self.plan.arrays) else None,
        )


def _restored(saved: SavedSimulation) -> Simulator:
    sim = Simulator(saved.scene, **saved.settings)
    sim.set_material(**saved.material)
    for name in saved.trained:
        getattr(sim, name).requires_grad_()
    reference = saved.reference
    # with the mesh it decides the bits of the preconditioner
    if reference is not None and not all(map(torch.equal, reference, reference_of_levels(sim.plan.arrays))):
        sim.plan = precondition_plan(sim.plan, sim.scene.values(), *reference)
    sim.choice = saved.choice
    sim.named_iterations = saved.named_iterations
    sim.check_iterations("Simulator.load")
    return sim
