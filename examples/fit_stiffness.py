"""Find the stiffness of both halves of a bar from its observed motion: gradients through many time steps."""

from __future__ import annotations

import argparse

import torch
from torch import Tensor
from torch.nn.utils import parametrize

import torchpd as tpd

TRUTH = (3e5, 6e4)  # Pa: beside the wall, and far from it
GUESS = 1.5e5  # Pa


class Halves(torch.nn.Module):
    """Stiffness of every tetrahedron [E] from the logarithms of two values, one for each half of the bar.

    The logarithm keeps a stiffness positive, and makes doubling as easy as halving.
    """

    def __init__(self, half: Tensor) -> None:
        super().__init__()
        self.half = half

    def forward(self, logarithm: Tensor) -> Tensor:
        return logarithm.exp()[self.half]

    def right_inverse(self, stiffness: Tensor) -> Tensor:
        return torch.stack([stiffness[self.half == number].log().mean() for number in (0, 1)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6, help="observed steps of 1/30 s")
    parser.add_argument("--fits", type=int, default=8, help="steps of the optimiser")
    options = parser.parse_args()

    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    bar = tpd.Solid(mesh, youngs=GUESS, density=1000.0)
    scene = tpd.Scene(bar, tpd.Pin(bar, mesh.vertices[:, 0] == 0.0), tpd.Gravity())
    # gradients are those of converged steps and as accurate as the steps: iterate until they change little
    sim = tpd.Simulator(scene, time_step=1 / 30, iterations=1000, dtype=torch.float64, tolerance=1e-7)
    half = torch.from_numpy((mesh.vertices[mesh.tets].mean(axis=1)[:, 0] > 0.5).astype(int))

    parametrize.register_parametrization(sim, "stiffness", Halves(half))
    logarithm = sim.parametrizations.stiffness.original.requires_grad_()

    def motion() -> Tensor:
        """Positions after every step [steps, 1, V, 3]."""
        return sim.rollout(sim.rest_state(), options.steps).positions

    with torch.no_grad():
        logarithm.copy_(torch.tensor(TRUTH).log())
        seen = motion()
        logarithm.copy_(torch.full((2,), GUESS).log())

    optimiser = torch.optim.LBFGS([logarithm], max_iter=2, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        error = 1e4 * (motion() - seen).square().sum(dim=-1).mean()  # cm^2
        error.backward()
        return error.detach()

    print("fit   beside the wall [Pa]   far from it [Pa]   distance [cm]")
    for fit in range(options.fits):
        youngs = logarithm.detach().exp().tolist()
        distance = float(optimiser.step(loss)) ** 0.5  # at the printed values: evaluated before they are updated
        print(f"{fit:3d} {youngs[0]:22,.0f} {youngs[1]:18,.0f} {distance:15.5f}")
    youngs = logarithm.detach().exp().tolist()
    print(f"end {youngs[0]:22,.0f} {youngs[1]:18,.0f}   the truth: {TRUTH[0]:,.0f} and {TRUTH[1]:,.0f}")


if __name__ == "__main__":
    main()
