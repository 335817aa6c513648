"""Steps by the instructions of this process, or by others in one of its own: python simd_steps.py FUNCTION."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from environments import different_environments, scene
from runs import simulator, state_of
from stretch_cases import KINDS, small_body

import torchpd as pd

FILE = Path(__file__).resolve()


def own_simd() -> str:
    return str(pd._C.build_info()["simd"])


def fields() -> dict[str, Any]:
    """Velocities and energies of single and of several environments in both precisions."""
    out = {}
    for dtype in (torch.float32, torch.float64):
        sim = simulator(scene(), dtype, iterations=12)
        for batch in (1, 9):
            state, forces = different_environments(sim, batch)
            after = sim(state, forces)
            out[f"{dtype} {batch}"] = [after.velocities.double().flatten().tolist(), sim.energy(state).tolist()]
    return out


def alone_and_in_a_batch() -> list[bool]:
    """Whether they are the same bits for each of 19 environments of each kind, and finite for each kind."""
    same = []
    for kind in KINDS:
        case = small_body(kind)
        sim = simulator(case, torch.float32, iterations=12)
        one = state_of(case, sim)
        scale = torch.linspace(0.5, 1.5, 19)[:, None, None]
        together = pd.State(one.positions * (0.8 + 0.2 * scale), one.velocities * scale)
        track = sim.rollout(together, 2)
        for item in range(19):
            alone = sim.rollout(pd.State(*(t[item : item + 1] for t in together)), 2)
            same.append(torch.equal(alone.velocities[:, 0], track.velocities[:, item]))
        same.append(bool(torch.isfinite(track.velocities).all()))
    return same


FUNCTIONS: dict[str, Callable[[], Any]] = {of.__name__: of for of in (fields, alone_and_in_a_batch)}


def results_with(simd: str, function: Callable[[], Any]) -> Any:
    """What the function gives with these instructions, in this process if it has them."""
    if simd == own_simd():
        return function()
    paths = os.pathsep.join(map(str, (FILE.parents[1], Path(pd.__file__).parents[1])))
    done = subprocess.run(
        [sys.executable, str(FILE), function.__name__],
        env={**os.environ, "TORCHPD_SIMD": simd, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["simd"] == simd
    return found["results"]


if __name__ == "__main__":
    sys.stdout.write(json.dumps({"simd": own_simd(), "results": FUNCTIONS[sys.argv[1]]()}))
