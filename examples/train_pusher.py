"""Train a policy that pushes soft cubes of random stiffness and weight to goals: gradients through contact, in batches.

`python examples/train_pusher.py --device cuda --batch 512` trains in 512 environments side by side.
"""

from __future__ import annotations

import argparse
import math
import resource
import time

import torch
from torch import Tensor, nn

import torchpd as tpd

TIME_STEP = 1 / 60  # s
# along x and z [m/s], and about y [rad/s]: how the paddle moves at first, and what the policy changes at most
FIRST, MOST = (0.1, 0.0, 0.0), (0.3, 0.3, 3.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=16, help="environments")
    parser.add_argument("--steps", type=int, default=24, help="of 1/60 s")
    parser.add_argument("--tries", type=int, default=20, help="steps of the optimiser")
    parser.add_argument("--cells", type=int, default=3, help="of the cube along an edge")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    batch, device = options.batch, torch.device(options.device)

    mesh = tpd.shapes.box((0.05, 0.05, 0.05), (options.cells,) * 3).translated((-0.025, 0.0, -0.025))
    paddle = tpd.Collider(
        tpd.shapes.box((0.01, 0.04, 0.08), (1, 1, 1)).translated((-0.037, 0.006, -0.04)), friction=0.4
    )
    parts = tpd.Solid(mesh, youngs=1e5, density=1000.0), paddle, tpd.Ground(friction=0.4), tpd.Contact(thickness=1e-3)
    sim = tpd.Simulator(tpd.Scene(*parts, tpd.Gravity()), TIME_STEP, 64, batch=batch, device=device, progress=False)
    share = sim.masses / sim.masses.sum()
    torch.manual_seed(0)
    random = torch.rand(batch, 4).to(device)
    sim.set_material(stiffness=5e4 * 4.0 ** random[:, :1], masses=2.0 ** (2.0 * random[:, 1:2] - 1.0) * sim.masses)
    goals = torch.tensor([0.03, -0.015], device=device) + random[:, 2:] * torch.tensor([0.03, 0.03], device=device)
    first, most = torch.tensor([FIRST, MOST], device=device)
    policy = nn.Sequential(nn.Linear(7, 32), nn.Tanh(), nn.Linear(32, 3), nn.Tanh()).to(device)

    def distances() -> Tensor:
        """Distances of the cubes from their goals at the end [B] m, of paddles that the policy leads."""
        state, place = sim.rest_state(batch), torch.zeros(batch, 3, device=device)  # x, z and turn
        middle = torch.zeros(batch, 2, device=device)
        for step in range(options.steps):
            left = torch.full((batch, 1), 1.0 - step / options.steps, device=device)
            seen = torch.cat([20.0 * (goals - middle), 20.0 * (place[:, :2] - middle), place[:, 2:], left], dim=1)
            seen = torch.cat([seen, torch.ones_like(left)], dim=1)
            place = place + TIME_STEP * (first + most * policy(seen))
            (x, z, angle), zero = place.unbind(1), torch.zeros_like(place[:, 0])
            pose = torch.stack([x, zero, z, torch.cos(angle / 2), zero, torch.sin(angle / 2), zero], dim=1)
            state = sim(state, targets={paddle: pose})
            middle = (share[:, None] * state.positions).sum(1)[:, [0, 2]]
        return (middle - goals).norm(dim=1)

    optimiser = torch.optim.Adam(policy.parameters(), lr=0.02)
    print(f"{batch} environments of {sim.vertices} vertices\ntry   from the goals [mm]   environment steps a second")
    for number in range(options.tries):
        begin = time.perf_counter()
        optimiser.zero_grad()
        loss = distances().square().mean()
        loss.backward()
        if not all(bool(weight.grad.isfinite().all()) for weight in policy.parameters()):
            raise RuntimeError("a gradient is not finite")
        optimiser.step()
        rate = batch * options.steps / (time.perf_counter() - begin)
        print(f"{number:3d} {1000 * math.sqrt(loss.item()):23.3f} {rate:28,.0f}", flush=True)
    with torch.no_grad():
        print(f"end {1000 * distances().square().mean().sqrt().item():23.3f}")
    kibibytes = torch.cuda.max_memory_allocated(device) / 1024 if device.type == "cuda" else None
    print(f"memory: {(kibibytes or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
