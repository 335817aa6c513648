"""Train one network on several GPUs or processes, each with its own environments.

torchrun --nproc-per-node 2 examples/train_distributed.py
"""

from __future__ import annotations

import argparse
import os

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

import torchpd as tpd


class Thrower(nn.Module):
    """A network that chooses the throwing speed of a cube, and the steps of the flight."""

    def __init__(self, sim: tpd.Simulator, steps: int) -> None:
        super().__init__()
        self.sim, self.steps = sim, steps
        self.network = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 1))

    def forward(self, goal: Tensor) -> Tensor:
        """Final positions of the cubes of all environments along x [B] m."""
        known = torch.stack([goal, self.sim.damping], dim=1)
        speed = self.network(known)  # [B, 1] m/s
        start = self.sim.rest_state()
        along = torch.tensor([1.0, 0.0, 0.0], device=goal.device)
        velocities = start.velocities + (speed * along)[:, None]
        end = self.sim.rollout(tpd.State(start.positions, velocities), self.steps).state()
        return end.positions[..., 0].mean(dim=1)


def train(options: argparse.Namespace) -> None:
    gpu = torch.cuda.is_available()
    rank, ranks = dist.get_rank(), dist.get_world_size()
    device = torch.device("cuda", int(os.environ["LOCAL_RANK"])) if gpu else torch.device("cpu")

    # every rank draws the random numbers of all environments from one seed and takes its share of them
    random = torch.rand(options.environments, 3, generator=torch.Generator().manual_seed(0))[rank::ranks].to(device)
    goal, drag, youngs = 0.5 * random[:, 0], 2.0 * random[:, 1], 1e4 * 10.0 ** random[:, 2]
    cube = tpd.Solid(tpd.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)).translated((-0.05, 0.0, 0.0)), youngs=1e5)
    sim = tpd.Simulator(tpd.Scene(cube), 1 / 60, 30, batch=len(goal), progress=False).to(device)
    sim.set_material(damping=drag[:, None], stiffness=youngs[:, None])

    torch.manual_seed(0)
    model = DistributedDataParallel(tpd.keep_material_per_rank(Thrower(sim, options.steps).to(device)))
    optimiser = torch.optim.Adam(model.parameters(), lr=0.01)
    for update in range(options.updates + 1):
        loss = (model(goal) - goal).square().mean()
        optimiser.zero_grad()
        loss.backward()  # averages the gradients of all ranks
        mean = loss.detach()
        dist.all_reduce(mean)
        if rank == 0 and update % 10 == 0:
            print(f"update {update:3d}: off by {1000 * (mean / ranks).sqrt():6.1f} mm")
        optimiser.step()
    print(f"rank {rank}: mean damping {sim.damping.mean():.4f} 1/s, weights {model.module.network[0].weight.sum():.6f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", type=int, default=64, help="environments of all ranks together")
    parser.add_argument("--steps", type=int, default=10, help="of 1/60 s")
    parser.add_argument("--updates", type=int, default=50, help="of the network")
    options = parser.parse_args()
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    train(options)
    dist.destroy_process_group()  # last: a model that still held the group would end its threads at exit


if __name__ == "__main__":
    main()
