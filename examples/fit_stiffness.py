"""Find how stiff the two halves of a bar are from how it was seen to move: gradients through many time steps."""

from __future__ import annotations

import argparse

import torch
from torch.func import functional_call

import torchpd as pd

TRUTH = (3e5, 6e4)  # Pa: beside the wall, and far from it
GUESS = 1.5e5  # Pa


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6, help="of 1/30 s that were seen")
    parser.add_argument("--fits", type=int, default=8, help="steps of the optimiser")
    options = parser.parse_args()

    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    bar = pd.Solid(mesh, youngs=GUESS, density=1000.0)
    scene = pd.Scene(bar, pd.Pin(bar, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    # gradients are those of converged steps, and as accurate as the steps are: iterate until little changes
    sim = pd.Simulator(scene, time_step=1 / 30, iterations=1000, dtype=torch.float64, tolerance=1e-7)
    half = torch.from_numpy((mesh.vertices[mesh.tets].mean(axis=1)[:, 0] > 0.5).astype(int))

    def motion(youngs: torch.Tensor) -> torch.Tensor:
        """Positions after every step [steps, 1, V, 3], with other values in the place of the module's parameter."""
        state, positions = sim.rest_state(), []
        for _ in range(options.steps):
            state = functional_call(sim, {"stiffness": youngs[half]}, (state,))
            positions.append(state.positions)
        return torch.stack(positions)

    with torch.no_grad():
        seen = motion(torch.tensor(TRUTH, dtype=torch.float64))

    # the logarithm keeps a stiffness positive, and makes doubling as easy as halving
    logarithm = torch.full((2,), GUESS, dtype=torch.float64).log().requires_grad_()
    optimiser = torch.optim.LBFGS([logarithm], max_iter=2, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        error = 1e4 * (motion(logarithm.exp()) - seen).square().sum(dim=-1).mean()  # cm^2
        error.backward()
        return error.detach()

    print("fit   beside the wall [Pa]   far from it [Pa]   distance [cm]")
    for fit in range(options.fits):
        youngs = logarithm.detach().exp().tolist()
        distance = float(optimiser.step(loss)) ** 0.5  # at these values: measured before the optimiser goes on
        print(f"{fit:3d} {youngs[0]:22,.0f} {youngs[1]:18,.0f} {distance:15.5f}")
    youngs = logarithm.detach().exp().tolist()
    print(f"end {youngs[0]:22,.0f} {youngs[1]:18,.0f}   the truth: {TRUTH[0]:,.0f} and {TRUTH[1]:,.0f}")


if __name__ == "__main__":
    main()
