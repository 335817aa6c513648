"""What each of two processes does in test_distributed.py: python two_ranks.py RANK FOLDER."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

import torchpd as pd

ENVIRONMENTS = 4


def youngs() -> Tensor:
    """Of every environment [B] [Pa]."""
    return torch.linspace(1e4, 1e5, ENVIRONMENTS, dtype=torch.float64)


class Falling(nn.Module):
    """Bars on a wall that sag, with a force that is learned and a damping that is learned for all of them."""

    def __init__(self, stiffness: Tensor) -> None:
        super().__init__()
        body = pd.Solid(pd.shapes.box((0.4, 0.1, 0.1), (4, 1, 1)), 1e5)
        scene = pd.Scene(body, pd.Pin(body, body.mesh.vertices[:, 0] == 0.0), pd.Gravity(), pd.Damping(1.0))
        self.sim = pd.Simulator(scene, 1 / 60, 400, dtype=torch.float64, progress=False)
        self.sim.set_material(stiffness=stiffness[:, None])
        self.sim.damping.requires_grad_()
        self.push = nn.Parameter(torch.tensor([0.0, 0.1, 0.05], dtype=torch.float64))

    def forward(self) -> Tensor:
        """Height of all bars after three steps, of each environment [B]."""
        state = self.sim.rest_state()
        forces = self.push.expand_as(state.positions)
        return self.sim.rollout(state, 3, forces=forces).positions[-1, ..., 1].mean(-1)


def gradients(module: nn.Module) -> dict[str, Tensor]:
    """Of what is learned, by name."""
    return {name: array.grad for name, array in module.named_parameters() if array.grad is not None}


def refusal(module: nn.Module) -> str:
    """What `DistributedDataParallel` says to a module."""
    try:
        DistributedDataParallel(module)
    except ValueError as error:
        return str(error)
    return ""


def main() -> None:
    rank, folder = int(sys.argv[1]), Path(sys.argv[2])
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=2)
    own = youngs()[rank::2]
    found: dict[str, Any] = {"refused": refusal(Falling(own))}

    model = pd.keep_material_per_rank(Falling(own))
    model.push.data.mul_(1.0 + rank)  # rank 0's is taken
    wrapped = DistributedDataParallel(model)
    wrapped().mean().backward()
    found["part"] = {"youngs": model.sim.stiffness[:, 0].detach(), "push": model.push.detach()}
    found["part"]["gradients"] = gradients(model)

    # the simulator itself, with an array that each environment learns
    sim = Falling(own).sim
    sim.stiffness.requires_grad_()
    found["refused alone"] = refusal(sim)
    wrapped = DistributedDataParallel(pd.keep_material_per_rank(sim))
    wrapped(sim.rest_state()).positions.sum().backward()
    found["alone"] = {"youngs": sim.stiffness[:, 0].detach(), "gradients": gradients(sim)}
    torch.save(found, folder / f"{rank}.pt")
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
