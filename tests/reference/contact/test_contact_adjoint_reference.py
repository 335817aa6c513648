"""The dense adjoint of the reference, against differences of converged steps."""

from __future__ import annotations

import pytest
import torch
from adjoint_scenes import CASES, seeded

# m, m/s, N: where neither truncation of a difference of fourth order nor rounding counts
STEPS = {
    "positions": 1e-7, "velocities": 1e-5, "forces": 1e-5, "start": 1e-7, "end": 1e-7, "contact_thickness": 1e-7,
    "membrane_poisson": 1e-2, "rest_length": 1e-6,
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::torchpd.MeshWarning")
@pytest.mark.parametrize("name", CASES)
def test_differences(name: str) -> None:
    """To 1e-6 of the difference along a random direction, for all that a step depends on.

    A gradient that is small beside its size has that of its size: a hundredth of it. Where more pairs slide, or are
    clamped, than there are directions, forces are not unique. Coarse corrections share their changes otherwise than the
    sweeps that the adjoint knows: there to 5e-3.
    """
    bound = 5e-3 if name in ("sliding cube", "clamp") else 1e-6
    step = CASES[name]()
    inputs, found = step.inputs(), step.reference_gradients()
    for number, (key, gradient) in enumerate(found.items()):
        direction = seeded(gradient, 10 + number)
        along = float((gradient * direction).sum())
        wanted = step.difference(key, direction, STEPS.get(key, 1e-2 * float(inputs[key].abs().max())))
        size = max(abs(wanted), 1e-2 * float(gradient.norm() * direction.norm()))
        assert abs(along - wanted) <= bound * size, key
    by_friction = step.reference().friction
    if float(by_friction.abs().max()) > 0.0:
        wanted = step.difference("contact_friction", torch.ones_like(inputs["contact_friction"]), 1e-5)
        assert float(by_friction.sum()) == pytest.approx(wanted, rel=bound)


def test_states_of_pairs() -> None:
    """The cases have pairs of every kind, and more pairs than directions."""
    states = {name: CASES[name]().reference().states for name in ("smooth cube", "sliding cube", "sticking cube")}
    for number, found in enumerate(states.values()):
        assert torch.equal(found, torch.full_like(found, number))
    assert len(states["smooth cube"]) > 9
