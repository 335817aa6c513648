"""Steps of scenes with stencils by the compiled solvers: known converged steps, iteration counts, the same bits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from stencil_scenes import (
    FIRM_CLOTH,
    MUSCLE_BEAMS,
    SOFT_CLOTH,
    StencilScene,
    chain,
    cloth,
    muscle_beam,
    pulled_spring,
)
from torch import Tensor

import torchpd as pd
from torchpd.plan.cpu_plan import compile_plan
from torchpd.plan.material import material_of, material_rows
from torchpd.plan.preconditioner import precondition_plan, reference_material

SCENES: dict[str, Callable[[], StencilScene]] = {
    "spring": pulled_spring,
    "chain": chain,
    "soft cloth": lambda: cloth(*SOFT_CLOTH),
    "firm cloth": lambda: cloth(*FIRM_CLOTH),
    "muscle above": lambda: muscle_beam(upper=MUSCLE_BEAMS[0][0], tip=MUSCLE_BEAMS[0][1], energy=MUSCLE_BEAMS[0][2]),
    "muscle": lambda: muscle_beam(upper=MUSCLE_BEAMS[1][0], tip=MUSCLE_BEAMS[1][1], energy=MUSCLE_BEAMS[1][2]),
}
# iterations to errors of 1e-1, 1e-2 and 1e-3, of an independent float64 prototype
CHEBYSHEV = {"chain": (10, 20, 26), "soft cloth": (187, 285, 470), "firm cloth": (514, 840, None)}
CHEBYSHEV["muscle above"] = (49, 103, 145)
# of a chain docs/limits.md says why
LBFGS = {"chain": (2, 10, 16), "soft cloth": (8, 50, 146), "firm cloth": (15, 97, None), "muscle above": (4, 7, 12)}
SLACK = 1.2  # of those counts


class Step:
    """One step of a scene by the op, for a batch of equal environments."""

    def __init__(self, scene: StencilScene, dtype: torch.dtype, solver: pd.Chebyshev | pd.Multilevel) -> None:
        self.scene, self.dtype, self.solver = scene, dtype, solver
        values = scene.values
        self.material = material_rows(material_of(values, dtype))
        plan = compile_plan(values, dtype=dtype, progress=False)
        if isinstance(solver, pd.Multilevel):
            plan = precondition_plan(plan, values, *reference_material(plan, self.material, scene.time_step))
        self.plan = list(plan.arrays)

    def __call__(self, iterations: int, batch: int = 1) -> tuple[Tensor, Tensor]:
        """Positions and info rows after so many iterations."""
        scene = self.scene
        at = scene.values.rest_positions if scene.positions is None else scene.positions
        x, v = (torch.tensor(a, dtype=self.dtype).expand(batch, -1, -1).clone() for a in (at, scene.velocities))
        out, _, info = torch.ops.torchpd.step(
            x, v, None, None, self.material, self.plan, **self.solver.settings(), iterations=iterations,
            time_step=scene.time_step, inertial=scene.start == "inertial", tolerance=0.0, report=True,
        )  # fmt: skip
        return out, info


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_converged_steps_are_known(name: str, dtype: torch.dtype) -> None:
    """Batches of 1 and 19 have the same bits: lanes over elements, and over environments."""
    scene = SCENES[name]()
    step = Step(scene, dtype, pd.Chebyshev())
    iterations = 2600 if "firm" in name else 1300
    out, info = step(iterations)
    # float32 loses up to ten of its digits' units for each of the iterations' tenth part
    tolerance = 1e-6 if dtype == torch.float64 else 2e-5
    for vertices, place in scene.places:
        np.testing.assert_allclose(out[0, vertices].mean(0).numpy(), place, atol=tolerance)
    assert info[0, 1].item() == pytest.approx(scene.energy, rel=1e-6 if dtype == torch.float64 else 1e-3)
    few, many = step(40), step(40, 19)
    assert torch.equal(few[0].expand_as(many[0]), many[0])
    assert torch.equal(few[1].expand_as(many[1]), many[1])


@pytest.mark.parametrize(("solver", "name"), [("lbfgs", n) for n in LBFGS] + [("chebyshev", n) for n in CHEBYSHEV])
def test_iterations_to_an_error(solver: str, name: str) -> None:
    expected = {"lbfgs": LBFGS, "chebyshev": CHEBYSHEV}[solver][name]
    chosen = pd.Multilevel() if solver == "lbfgs" else pd.Chebyshev()
    scene = SCENES[name]()
    exact = Step(scene, torch.float64, pd.Chebyshev())(4000 if "cloth" in name else 1000)[0]
    step = Step(scene, torch.float64, chosen)
    problem = scene.problem()
    guess = problem.target if scene.start == "inertial" else problem.time_step * problem.velocities
    away = (torch.from_numpy(problem.positions + problem.hold(guess)) - exact).norm()
    for error, count in zip((1e-1, 1e-2, 1e-3), expected, strict=True):
        if count is not None:
            # a larger slack of single iterations where there are few
            allowed = max(int(SLACK * count), count + 2)
            reached = min(float((step(allowed - back)[0] - exact).norm() / away) for back in range(3))
            assert reached <= error, (error, count)
