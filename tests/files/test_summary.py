"""What is not in the scene is not listed, costs no bytes and changes no bits."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from cases import Case, box
from newton_cases import strip
from runs import moving, same_bits, simulator

import torchpd as pd
from torchpd.common.gpu import Properties
from torchpd.files import summary
from torchpd.files.summary import workspace_bytes
from torchpd.plan import Plan
from torchpd.plan.compiled import CompiledScene
from torchpd.plan.kernel_choice import choose_plan

pytestmark = pytest.mark.usefixtures("poisoned")


WORDS = ("hard pins", "soft pins", "gravity", "damping", "grounds", "spheres")


def bare(*parts: Any) -> Case:
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    built = [part(body) if callable(part) else part for part in parts]
    return Case(pd.Scene(body, *built), vertices, 0.0 * vertices, 1 / 60)


def test_print_lists_only_what_is_in_the_scene() -> None:
    effects = {
        "hard pins": lambda body: pd.Pin(body, [0]),
        "soft pins": lambda body: pd.Pin(body, [0], 1e3),
        "gravity": pd.Gravity(),
        "damping": pd.Damping(1.0),
        "grounds": pd.Ground(),
        "spheres": pd.Sphere((0, -1, 0), 0.5),
    }
    assert set(effects) == set(WORDS)
    for name, effect in effects.items():
        text = str(simulator(bare(effect), torch.float32))
        assert [word for word in WORDS if f"{word}:" in text] == [name]
    text = str(simulator(bare(), torch.float32, iterations=17, tolerance=1e-3))
    assert not [word for word in WORDS if f"{word}:" in text]
    for fact in (
        "36 vertices",
        "72 tetrahedra",
        "at most 17 iterations",
        "Chebyshev guarded",
        "tolerance 0.001",
        "weighted diagonal",
    ):
        assert fact in text, fact


def test_absent_effects_add_no_bytes(dtype: torch.dtype) -> None:
    def size(case: Case) -> tuple[int, int]:
        sim = simulator(case, dtype)
        return sim.plan.bytes, sum(array.numel() for array in sim.material())

    plan, material = size(bare())
    # 72 moduli, 36 masses, gravity, damping: nothing for pins and contacts
    assert material == 72 + 36 + 3 + 1
    assert size(bare(pd.Gravity(), pd.Damping(1.0))) == (plan, material)
    assert size(bare(pd.Ground())) == (plan, material + 5)
    assert size(bare(pd.Sphere((0, -1, 0), 0.5))) == (plan, material + 8)
    # pins are numbers in the plan
    assert size(bare(lambda body: pd.Pin(body, [0]))) == (plan + 4, material + 4)
    assert size(bare(lambda body: pd.Pin(body, [0, 1, 3]))) == (plan + 12, material + 12)


def test_absent_effects_change_no_bits(dtype: torch.dtype, device: torch.device) -> None:
    """An effect without strength or out of reach gives the bits of a scene that never had it."""
    plain = simulator(bare(), dtype, device, iterations=9)
    state = moving(plain)
    expected = plain(state)
    for effect in (
        pd.Gravity((0, 0, 0)),
        pd.Damping(0.0),
        pd.Ground(-100.0, friction=0.0),
        pd.Sphere((0, -100, 0), 1.0),
    ):
        assert same_bits(simulator(bare(effect), dtype, device, iterations=9)(state), expected), effect


@pytest.mark.parametrize(
    ("kernel", "facts"),
    [
        (
            "block",
            (
                "1 patch,",
                "one thread block per environment",
                '"cluster", faster for a few environments (batch=1), "grid" or "stream"',
            ),
        ),
        (
            "cluster",
            (
                "2 patches,",
                "a cluster of thread blocks, one for each patch",
                "copies of tetrahedra",
                '"block", "grid" or "stream"',
            ),
        ),
        (
            "grid",
            (
                "2 patches,",
                "a thread block for each patch, all iterations in one launch",
                "vertices that patches share",
                '"block", "cluster" or "stream"',
            ),
        ),
        ("stream", ("1 patch,", "launches for every iteration")),
    ],
)
def test_print_says_how_a_gpu_would_step(kernel: str, facts: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary, "step_bytes", lambda *_: 1)  # which asks a GPU
    sim = simulator(bare(pd.Ground()), torch.float32)
    values = sim.scene.values()
    sim.plan = choose_plan(values, torch.float32, Properties(132, 232_448, 16), kernel)
    text = str(sim)
    for fact in (*facts, f"kernel {kernel}:", f"why {kernel}: asked for", f"plan {sim.plan.bytes:,} B", "grounds: 1"):
        assert fact in text, fact
    assert "SIMD" not in text
    sim.plan = choose_plan(values, torch.float32, Properties(132, 232_448))
    assert "why block: shared memory per thread block: block needs" in str(sim)
    assert "232,448 B are available" in str(sim)
    for kernel, depends in (("auto", True), ("block", True), ("grid", True), ("cluster", False), ("stream", False)):
        told = simulator(bare(pd.Ground()), torch.float32, batch=7, kernel=kernel)
        told.plan = sim.plan
        assert ("; for a batch of 7; " in str(told)) == depends


@pytest.mark.parametrize("kernel", ["block", "stream"])
def test_print_says_what_a_step_takes_on_a_gpu(kernel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each environment in the batch it was told, rounded up; but for a stream no more than those in work want."""

    def taken(_: CompiledScene, plan: Plan, batch: int, device: torch.device) -> int:
        assert (plan.kernel, device.type) == (kernel, "cpu")
        return 1000 * min(batch, 9) + 1

    monkeypatch.setattr(summary, "step_bytes", taken)
    most = ", at most 9,001 B in all" if kernel == "block" else ""
    for batch, words in (
        (None, "1,001 B per environment during a step"),
        (12, "751 B per environment during a step of 12"),
    ):
        sim = simulator(bare(), torch.float32, batch=batch)
        sim.plan = choose_plan(sim.scene.values(), torch.float32, Properties(132, 232_448), kernel)
        assert str(sim).splitlines()[-2].endswith(f" B, {words}{most}")


@pytest.mark.parametrize(("outer", "more"), [("momentum", 8), ("lbfgs", 24 + 2)])
def test_workspace_of_the_multilevel_solver(outer: str, more: int) -> None:
    """Quads of a vertex beside those of Chebyshev, and two matrices of six modes of each piece."""
    sim = simulator(bare(), torch.float32, solver=pd.Multilevel(outer))
    pieces = int(sim.plan.piece_of.max()) + 1
    assert pieces == 7
    extra = workspace_bytes(sim.plan, 4, sim.solver) - workspace_bytes(sim.plan, 4, pd.Chebyshev())
    assert extra == 16 * 36 * more + (8 * 2 * (6 * pieces) ** 2 if outer == "lbfgs" else 0)


def test_workspace_of_newton() -> None:
    """Beside that of L-BFGS: twenty numbers of a tetrahedron; symmetric matrices of six and three rows of stencils."""
    for case, numbers in ((bare(), 20 * 5 * 16), (strip(), (3 * 21 + 4 * 6) * 16)):
        plan = simulator(case, torch.float32, solver=pd.Newton()).plan
        assert workspace_bytes(plan, 4, pd.Newton()) == workspace_bytes(plan, 4, pd.Multilevel()) + 4 * numbers
