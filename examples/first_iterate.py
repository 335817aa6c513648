"""Effect of the first iterate and the number of iterations: errors of a step against the converged step."""

from __future__ import annotations

import argparse

import torch

import torchpd as tpd

TIME_STEP = 1 / 30  # s


def build(youngs: float, iterations: int, tolerance: float = 0.0) -> tpd.Simulator:
    """A bar held by a wall, in float64."""
    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (15, 3, 3))
    bar = tpd.Solid(mesh, youngs=youngs, density=1000.0)
    scene = tpd.Scene(bar, tpd.Pin(bar, mesh.vertices[:, 0] == 0.0), tpd.Gravity())
    return tpd.Simulator(scene, TIME_STEP, iterations, dtype=torch.float64, tolerance=tolerance)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--youngs", type=float, default=3e5, help="Young's modulus [Pa]")
    parser.add_argument("--iterations", type=int, nargs="+", default=[4, 16, 64, 256])
    parser.add_argument("--steps", type=int, default=5, help="steps before the one that is examined")
    options = parser.parse_args()

    accurate = build(options.youngs, iterations=4000, tolerance=1e-12)
    positions, velocities = accurate.rest_state()
    velocities[..., 1] = -3.0 * positions[..., 0] ** 2
    state = tpd.State(positions, velocities)
    for _ in range(options.steps):
        state = accurate(state)
    exact, info = accurate(state, return_info=True)
    moved = (exact.positions - state.positions).norm()
    print(f"the step converges in {int(info.iterations)} iterations to a residual of {float(info.residual):.1e}\n")

    # a first iterate may be any tensor, such as a network's output: this one predicts a fifth of the change
    unchanged = state.positions + TIME_STEP * state.velocities
    guess = unchanged + 0.2 * (exact.positions - unchanged)
    print("error of the displacement, by first iterate:")
    print("iterations " + "".join(f"{name:>12}" for name in ("velocity", "inertial", "proposal")))
    for count in options.iterations:
        sim = build(options.youngs, count)
        ends = [sim(state, start=start).positions for start in ("velocity", "inertial", guess)]
        print(f"{count:10d} " + "".join(f"{float((end - exact.positions).norm() / moved):12.1e}" for end in ends))

    print("\nstopping where about so much of the way from the targets is left:")
    print(" tolerance  iterations       error    residual")
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5):
        end, info = build(options.youngs, 2000, tolerance)(state, return_info=True)
        error = float((end.positions - exact.positions).norm() / moved)
        print(f"{tolerance:10.0e} {int(info.iterations):11d} {error:11.1e} {float(info.residual):11.1e}")


if __name__ == "__main__":
    main()
