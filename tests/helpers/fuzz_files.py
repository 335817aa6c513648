"""Damaged mesh files: each is read or refused by name, in time, in silence and within a bound of memory.

`python tests/helpers/fuzz_files.py 5000` damages so many files, made from small sound ones of every format, and
reports; a second number is that of the first file, for others than the last time.
"""

from __future__ import annotations

import faulthandler
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from fuzz_seeds import Seed, make_seeds

from torchpd import MeshWarning

__all__ = ["main"]

SECONDS = 2.0  # of one core, for one file
MEMORY = 1 << 30  # bytes, beyond what is used before the first file
HOSTILE = (0, -1, 2**31, 10**15)


def cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def empty(data: bytes, rng: random.Random) -> bytes:
    return rng.choice([b"", b"\n", data[:1], b"\0" * len(data)])


def flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice([1, 2, 5, 20])):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def replace_number(data: bytes, rng: random.Random) -> bytes:
    """A number of a text, most often one at its begin."""
    numbers = list(re.finditer(rb"-?\d+", data))
    if not numbers:
        return flip(data, rng)
    match = numbers[min(int(rng.expovariate(0.05)), len(numbers) - 1)] if rng.random() < 0.7 else rng.choice(numbers)
    return data[: match.start()] + str(rng.choice(HOSTILE)).encode() + data[match.end() :]


def replace_bytes(data: bytes, rng: random.Random) -> bytes:
    """Four or eight bytes as an integer of either byte order, most often near the begin."""
    size = rng.choice([4, 8])
    place = min(
        int(rng.expovariate(0.01)) if rng.random() < 0.7 else rng.randrange(len(data)), max(len(data) - size, 0)
    )
    value = rng.choice(HOSTILE) % 2 ** (8 * size)
    return data[:place] + value.to_bytes(size, rng.choice(["little", "big"])) + data[place + size :]


def swap_lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def drop_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


DAMAGES: list[Callable[[bytes, random.Random], bytes]] = [
    cut, cut, flip, flip, replace_number, replace_number, replace_bytes, swap_lines, drop_line, empty,
]  # fmt: skip


def damage(seed: Seed, number: int) -> str:
    """Damage the file of a seed or one that belongs to it, the same way for the same number; how."""
    rng = random.Random(f"{seed.path.name} {number}")
    target = rng.choice([seed.path, seed.path, *seed.beside])
    work = rng.choice(DAMAGES)
    target.write_bytes(work(target.read_bytes(), rng))
    return f"{work.__name__} of {target.name}"


class Silence:
    """Counts the bytes that the process writes to stdout and stderr, whoever writes them."""

    def __init__(self, log: Path) -> None:
        self.log = os.open(log, os.O_CREAT | os.O_WRONLY)
        self.file = tempfile.TemporaryFile()  # noqa: SIM115
        sys.stdout.flush()
        sys.stderr.flush()
        self.kept = os.dup(1), os.dup(2)
        os.dup2(self.file.fileno(), 1)
        os.dup2(self.file.fileno(), 2)

    def taken(self) -> bytes:
        sys.stdout.flush()
        sys.stderr.flush()
        self.file.seek(0)
        words = self.file.read()
        self.file.seek(0)
        self.file.truncate()
        return words

    def end(self) -> None:
        for old, number in zip(self.kept, (1, 2), strict=True):
            os.dup2(old, number)


def try_file(seed: Seed, path: Path) -> tuple[str, str]:
    """What became of a file, and what is wrong with that ("" if nothing)."""
    begin = time.process_time()
    fault = ""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            seed.kind.from_file(path)
            end = "read"
        except (ValueError, FileNotFoundError) as error:
            end = "refused"
            if path.name not in str(error):
                fault = f"an error that does not name the file: {error!r}"
            if "memory" in str(error):
                fault = f"memory: {error}"
        except ModuleNotFoundError as error:
            end, fault = "missing", str(error)
        except BaseException as error:
            end, fault = "error", repr(error)
    seconds = time.process_time() - begin
    strange = [str(warning.message) for warning in said if not issubclass(warning.category, MeshWarning)]
    if strange:
        fault = f"a warning: {strange[0]}"
    if seconds > SECONDS:
        fault = f"{seconds:.1f} s"
    return end, fault


def stop(*_: object) -> None:
    """Ends a reader that runs on and on; `try_file` sees how long it took."""
    raise TimeoutError


def limit_memory() -> None:
    """No more memory than `MEMORY` beyond what is mapped now; only Linux says how much that is."""
    if sys.platform != "linux":
        return
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, resource.RLIM_INFINITY))


def run(numbers: range, folder: Path, silence: Silence) -> tuple[Counter[str], list[str]]:
    """What became of damaged files, the seeds in turn, and what is wrong with it."""
    seeds, faults = [], []
    for seed in make_seeds(folder):
        end, fault = try_file(seed, seed.path)
        if end != "missing":
            seeds.append(seed)
            if end != "read" or fault:
                faults.append(f"{seed.path.name} is sound, but {end}: {fault}")
    silence.taken()
    limit_memory()
    signal.signal(signal.SIGPROF, stop)
    ends: Counter[str] = Counter()
    for number in numbers:
        seed = seeds[number % len(seeds)]
        place = folder / "work"
        shutil.copytree(seed.path.parent, place)
        copy = Seed(place / seed.path.name, seed.kind, tuple(place / path.name for path in seed.beside))
        how = f"{number}: {damage(copy, number)}, read by {seed.kind.__name__}"
        # A reader that never returns, or that crashes, leaves behind what it read.
        os.pwrite(silence.log, how.ljust(200).encode(), 0)
        faulthandler.dump_traceback_later(60.0, exit=True, file=silence.kept[1])
        signal.setitimer(signal.ITIMER_PROF, 1.5 * SECONDS)
        end, fault = try_file(copy, copy.path)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        faulthandler.cancel_dump_traceback_later()
        if words := silence.taken():
            fault = f"prints {words[:200]!r}"
        if fault:
            faults.append(f"{how}: {fault[:400]}")
        ends[end] += 1
        shutil.rmtree(place)
    return ends, faults


def main(numbers: range, folder: Path) -> int:
    """Run, and report on stdout; how many faults there are."""
    begin, silence = time.perf_counter(), Silence(folder / "last")
    (folder / "seeds").mkdir()
    try:
        ends, faults = run(numbers, folder / "seeds", silence)
    finally:
        silence.end()
    print(f"{len(numbers)} damaged files in {time.perf_counter() - begin:.1f} s: {dict(ends)}, {len(faults)} faults")
    print("\n".join(faults))
    return len(faults)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        count, first = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
        sys.exit(min(main(range(first, first + count), Path(place)), 1))
