"""The memory that a process may have, in containers told by files made here."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from torchpd.common import memory

PHYSICAL = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
UNLIMITED = 9223372036854771712  # what version 1 says then

V1, V2 = "sys/fs/cgroup/memory", "sys/fs/cgroup"
OLD, NEW = "memory.limit_in_bytes", "memory.max"


def machine(root: Path, groups: str, files: dict[str, object]) -> Path:
    for name, text in {"proc/self/cgroup": groups, **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")
    return root


@pytest.mark.parametrize(
    ("groups", "files", "least"),
    [
        ("0::/", {f"{V2}/{NEW}": 1000}, 1000),
        ("0::/a/b", {f"{V2}/a/b/{NEW}": "max", f"{V2}/a/{NEW}": 2000, f"{V2}/{NEW}": "max"}, 2000),
        ("0::/a/b", {f"{V2}/a/b/{NEW}": 500, f"{V2}/a/{NEW}": 2000}, 500),
        ("0::/", {f"{V2}/{NEW}": "max"}, PHYSICAL),
        ("3:cpu:/\n2:memory:/a\n0::/", {f"{V1}/a/{OLD}": 3000, f"{V1}/{OLD}": UNLIMITED}, 3000),
        ("2:hugetlb,memory:/a\n0::/", {f"{V1}/a/{OLD}": UNLIMITED, f"{V1}/{OLD}": 4000}, 4000),
        # the path of the host, of which a container sees only its own part as the root
        ("2:memory:/docker/1234", {f"{V1}/{OLD}": 5000}, 5000),
        ("0::/../../other", {f"{V2}/{NEW}": 6000}, 6000),
        ("2:memory:/a", {f"{V1}/a/{OLD}": UNLIMITED}, PHYSICAL),
        ("2:memory:/a", {f"{V1}/a/{OLD}": "no number"}, PHYSICAL),
        ("without colons", {}, PHYSICAL),
    ],
)
def test_the_least_limit_counts(groups: str, files: dict[str, object], least: int, tmp_path: Path) -> None:
    assert memory.host_memory(machine(tmp_path, groups, files)) == least


def test_without_control_groups_it_is_the_machine_s(tmp_path: Path) -> None:
    assert memory.host_memory(tmp_path) == PHYSICAL
