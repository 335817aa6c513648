"""Threads of a step on the CPU: beside other processes, after a fork, in threads of Python."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from typing import Any

import pytest
from runs import moving, same_bits
from small_scene import scene

import torchpd as pd

PROGRAM = """
import json, os, time
import torch
import torchpd as pd

torch.set_num_threads(2)
body = pd.Solid(pd.shapes.box((0.4, 0.1, 0.1), (16, 4, 4)), 1e5)
sim = pd.Simulator(pd.Scene(body, pd.Gravity()), 1 / 60, 8, progress=False)
state = sim.rest_state()
after = sim(state)
child = os.fork()
same = torch.equal(sim(sim.rest_state()).positions, after.positions)
if child == 0:
    os._exit(0 if same else 1)
found = {"child": os.waitpid(child, 0)[1], "parent": same}
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sim.iterations = 64

    def seconds(threads):
        torch.set_num_threads(threads)
        begin = time.process_time()
        for _ in range(20):
            sim(state)
        return time.process_time() - begin

    seconds(2)
    found["times as long"] = min(seconds(2) / seconds(1) for _ in range(3))
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    """Of a process that forks, and then is held on one core."""
    if not hasattr(os, "fork"):
        pytest.skip("no fork")
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=100)
    return dict(json.loads(run.stdout))


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux alone holds a process on a core")
def test_a_thread_without_a_core_is_not_waited_for(found: dict[str, Any]) -> None:
    """Two threads on one core take as long as one, not a time slice more at each of some hundred barriers."""
    assert found["times as long"] < 3


def test_a_child_of_a_fork_has_threads_of_its_own(found: dict[str, Any]) -> None:
    assert (found["child"], found["parent"]) == (0, True)


def test_threads_of_python_step_side_by_side(two_threads: None) -> None:
    sim = pd.Simulator(scene(), 1 / 60, 8, progress=False)
    states = [moving(sim, batch) for batch in (1, 3, 20, 40)]
    expected, found = [sim(state) for state in states], {}

    def run(number: int) -> None:
        for _ in range(20):
            found[number] = sim(states[number])

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(states))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(same_bits(found[number], state) for number, state in enumerate(expected))
