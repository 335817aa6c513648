"""What holds arrays prints as one line of sizes, whatever those arrays hold and however many numbers they have."""

from __future__ import annotations

import pytest
import torch
from torch._subclasses import FakeTensorMode

import torchpd as pd
from torchpd.simulation.wrenches import Wrench
from torchpd.viewing.render import Camera

MESH = pd.shapes.box((1.0, 0.2, 0.2), (5, 1, 1))
SOLID = pd.Solid(MESH, youngs=1e5)
PIN = pd.Pin(SOLID, range(4))
GROUND = pd.Ground(friction=0.5)
SIM = pd.Simulator(pd.Scene(SOLID, PIN, GROUND, pd.Gravity()), iterations=3)
STATE = SIM.rest_state(2)
FLOWING = pd.Simulator(pd.Scene(pd.Solid(MESH, youngs=1e5, plastic=pd.Plastic(0.1))), iterations=3)
TRACK = FLOWING.rollout(FLOWING.rest_state(2), 3)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (STATE, "State(batch=2, vertices=24, float32, cpu)"),
        (SIM.rollout(STATE, 3), "Track(records=3, batch=2, vertices=24, float32, cpu)"),
        (TRACK, "HistoryTrack(records=3, batch=2, vertices=24, float32, cpu)"),
        (TRACK.state(), "HistoryState(batch=2, vertices=24, float32, cpu)"),
        (TRACK.state().history, "History(batch=2, plastic=30, float32, cpu)"),
        (TRACK.history, "History(records=3, batch=2, plastic=30, float32, cpu)"),
        (FLOWING.history_at_rest(), "History(plastic=30, float32, cpu)"),
        (SOLID, "Solid(mesh=TetMesh(24 vertices, 30 tets), youngs=100000, density=1000)"),
        (PIN, f"Pin(body={SOLID!r}, vertices=[0, 1, 2, 3], stiffness=None)"),
        (GROUND, "Ground(height=0.0, normal=[0.0, 1.0, 0.0], friction=0.5)"),
        (pd.Gravity(), "Gravity(vector=[0.0, -9.81, 0.0])"),
        (
            pd.Solid(MESH, torch.arange(1, 31) * 1e3),
            "youngs=float64 [30], density=1000)",
        ),
        (SIM.contact_forces(STATE, STATE), "ContactForces(batch=2, vertices=24, float32, cpu)"),
        (SIM.contact_forces(STATE, STATE).colliders[GROUND], "ContactForce(batch=2, vertices=24, float32, cpu)"),
        (SIM.reactions(STATE, STATE), "Reactions(batch=2, pinned=4, float32, cpu)"),
        (SIM.reactions(STATE, STATE).pins[PIN], "PinForce(batch=2, pinned=4, float32, cpu)"),
        (Wrench(*torch.zeros(3, 2, 3)), "Wrench(batch=2, float32, cpu)"),
        (SIM.stress(STATE), "Stress(batch=2, tets=30, float32, cpu)"),
        (SIM.plan, "Plan(24 vertices, 1 patches, "),
    ],
    ids=lambda value: type(value).__name__,
)
def test_one_line_of_sizes(value: object, text: str) -> None:
    printed = repr(value)
    assert text in printed
    assert "\n" not in printed


def test_info_tells_its_worst() -> None:
    _, info = SIM(STATE, return_info=True)
    worst = f"residual<={float(info.residual.max()):.2g}, iterations<=3"
    assert repr(info) == f"Info(batch=2, {worst}, float64, cpu)"
    assert repr(SIM.rollout(STATE, 4, return_info=True).info).startswith("Info(records=4, batch=2, residual<=")
    assert repr(SIM(SIM.rest_state(0), return_info=True)[1]) == "Info(batch=0, float64, cpu)"  # which has no worst


def test_tensors_without_values_print() -> None:
    with FakeTensorMode() as mode:
        traced = pd.State(*(mode.from_tensor(part) for part in STATE))
        assert repr(traced) == "State(batch=2, vertices=24, float32, cpu)"
    assert repr(STATE.to("meta")) == "State(batch=2, vertices=24, float32, meta)"
    rows = torch.zeros(2, 7, dtype=torch.float64, device="meta")
    assert repr(pd.Info.from_rows(rows)) == "Info(batch=2, float64, meta)"
    seen = []
    torch.func.vmap(lambda state: seen.append(repr(state)) or state)(STATE)
    assert seen == ["State(vertices=24, float32, cpu)"]


def test_free_form_patches() -> None:
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    patches = pd.FreeFormPatches(corners, torch.tensor([[0, 1, 2]]))
    samples = patches.samples(torch.zeros(2, dtype=torch.int32), torch.full((2, 3), 1 / 3))
    rays = pd.PatchRays(patches)
    towards = torch.tensor([[0.0, 0.0, -1.0]])
    pose = pd.PatchPose(corners[None], torch.eye(3).expand(1, 3, 3, 3))
    assert repr(pose) == "PatchPose(batch=1, vertices=3, float32, cpu)"
    assert repr(samples) == "PatchSamples(samples=2, float32, cpu)"
    assert repr(patches.surface(samples)) == "SurfacePoints(samples=2, float32, cpu)"
    assert repr(patches.surface(samples, pose)) == "SurfacePoints(batch=1, samples=2, float32, cpu)"
    assert repr(rays.cast(-towards, towards)) == "PatchHits(batch=1, rays=1, float32, cpu)"
    picture = rays.render(Camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=40.0), (4, 2))
    assert repr(picture) == "PatchImage(batch=1, height=2, width=4, float32, cpu)"
    assert repr(patches.tessellate(2)).endswith(
        "samples=PatchSamples(samples=6, float32, cpu), triangles=int64 [4, 3])"
    )
