"""Domain randomisation: environments that differ in stiffness, mass and gravity, simulated in one batch."""

from __future__ import annotations

import argparse
import time

import torch

import torchpd as tpd


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=64, help="environments")
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s")
    options = parser.parse_args()

    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (13, 3, 3))
    bar = tpd.Solid(mesh, youngs=1e5, density=1000.0)
    wall = tpd.Pin(bar, mesh.vertices[:, 0] == 0.0)
    scene = tpd.Scene(bar, wall, tpd.Gravity(), tpd.Damping(1.0))
    sim = tpd.Simulator(scene, time_step=1 / 60, iterations=64, batch=options.batch)

    # any material array may have a leading batch dimension: one value or array per environment
    generator = torch.Generator().manual_seed(0)
    random = torch.rand(options.batch, 3, generator=generator)
    youngs = 1e5 * 10.0 ** random[:, 0]  # 1e5 to 1e6 Pa
    density = 500.0 + 1000.0 * random[:, 1]  # kg/m^3
    sim.set_material(
        stiffness=youngs[:, None],
        masses=density[:, None] / 1000.0 * sim.masses,
        gravity=torch.stack(
            [0.5 * (random[:, 2] - 0.5), torch.full((options.batch,), -9.81), random[:, 2] * 0.0], dim=1
        ),
    )

    begin = time.perf_counter()
    track = sim.rollout(sim.rest_state(options.batch), options.steps, return_info=True)
    seconds = time.perf_counter() - begin

    tip = torch.from_numpy(mesh.vertices[:, 0] == 1.0)
    sag = mesh.vertices[:, 1].max() / 2 - track.positions[:, :, tip, 1].mean(dim=-1).amin(dim=0)
    print(f"{options.batch * options.steps / seconds:,.0f} environment-steps/s")
    print("environment   youngs [Pa]   density [kg/m^3]   deepest sag [m]")
    for number in sag.argsort(descending=True)[:5].tolist():
        print(f"{number:11d} {youngs[number]:13.0f} {density[number]:18.0f} {sag[number]:17.3f}")
    softness = torch.corrcoef(torch.stack([sag, density / youngs]))[0, 1]
    print(f"sag goes with density / youngs: correlation {softness:.2f}")
    print(f"largest residual of a step: {float(track.info.residual.max()):.1e}")


if __name__ == "__main__":
    main()
