"""Steps with contact on a GPU, for compute-sanitizer: every task of csrc/cuda/contact, by one block and by many."""

from __future__ import annotations

import torch
from body_scenes import gripper, simulator, two_cubes, two_sheets

if __name__ == "__main__":
    torch.cuda.init()
    for course, batch, iterations in ((two_cubes(), 3, 7), (gripper(0.8), 2, 7), (two_sheets(30), 1, 32)):
        sim = simulator(course.scene, iterations, dtype=torch.float32, device="cuda")
        state = sim.rest_state(batch)
        if course.velocities is not None:
            state.velocities[:] = torch.tensor(course.velocities)
        for number in range(4):
            given = None if course.targets is None else course.targets(8 * number)
            moved = None if given is None else {part: value.to(sim.rest_positions) for part, value in given.items()}
            state, info = sim(state, targets=moved, return_info=True)
        assert float(info.contact_gap.min()) > 0.09
