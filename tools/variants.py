"""Time changes to the kernels of one CUDA source side by side, on a GPU, with the extension built in place:

python tools/variants.py stream_float one-1M --patch wide.patch fewer.patch --tets 2304 2560

Clocks of equal GPUs differ by a tenth, so compare only times of one run. Each patch (in the format of `git diff`) is
applied to a copy of csrc/. The source is recompiled and linked with the other objects unchanged. A patch may therefore
change kernels and their launches, but no plan, and nothing visible to other sources. The scene is one of
benchmarks/gpu_scenes.py; --tets are tetrahedra per patch of kernel "stream". The unchanged tree runs first and last. A
row has microseconds per iteration, of a step of 64 and from 64 to 128 of them. A hash of the positions after four steps
compares the bits.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import pickle
import runpy
import shutil
import statistics
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch.utils import cpp_extension

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = ("c10", "torch", "torch_cpu", "torch_python", "cudart", "c10_cuda", "torch_cuda")


def run(*command: object, folder: Path = ROOT) -> None:
    """Run a command, or exit with its output."""
    words = [str(word) for word in command]
    result = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        sys.exit(f"{' '.join(words[:3])} ...: {result.stdout}{result.stderr}")


def contents(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def apply(patch: Path, folder: Path) -> None:
    """Apply a patch to the copy of csrc/ in a folder; changes outside csrc/ are ignored."""
    before = contents(folder / "csrc")
    run("git", "apply", "--include=csrc/*", patch.resolve(), folder=folder)
    if contents(folder / "csrc") == before:
        sys.exit(f"{patch} changes nothing in csrc/.")


def is_up_to_date(folder: Path) -> bool:
    """Return whether ninja (that of this environment first) has nothing to do in a folder."""
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    ninja = shutil.which("ninja", path=places)
    if ninja is None:
        sys.exit("tools/variants.py needs ninja, which builds the extension: run `pip install ninja`.")
    left = subprocess.run([ninja, "-n", "-C", str(folder)], capture_output=True, text=True, check=False)
    return "no work to do" in left.stdout


def objects() -> list[Path]:
    """The objects of the extension built in place for this python and torch, one per source."""
    folder = f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}-torch-{torch.__version__}"
    sources = [path.relative_to(ROOT) for kind in ("*.cpp", "*.cu") for path in (ROOT / "csrc").rglob(kind)]
    built = ROOT / "build" / folder
    found = [(built / path).with_suffix(".o") for path in sorted(sources)]
    if not all(path.exists() for path in found) or not is_up_to_date(built):
        sys.exit(f"build/{folder} is not of this csrc/: run `python setup.py build_ext --inplace` first.")
    return found


def make_variant(folder: Path, source: str, patch: Path | None, linked: list[Path], flags: Sequence[str]) -> None:
    """Make a package with its own extension in `folder`."""
    package = folder / "torchpd"
    shutil.copytree(ROOT / "torchpd", package, ignore=shutil.ignore_patterns("_C*.so", "__pycache__"))
    shutil.copytree(ROOT / "csrc", folder / "csrc")
    if patch is not None:
        apply(patch, folder)
    major, minor = torch.cuda.get_device_capability()
    target = f"-gencode=arch=compute_{major}{minor},code=sm_{major}{minor}"
    made = folder / f"{source}.o"
    nvcc = Path(str(cpp_extension.CUDA_HOME)) / "bin" / "nvcc"
    kernels = next((folder / "csrc").rglob(f"{source}.cu"))
    run(nvcc, "-c", kernels, "-o", made, *flags, target, "-Xcompiler=-fPIC", "-I", folder / "csrc")
    others = [path for path in linked if path.name != made.name]
    paths = [word for path in cpp_extension.library_paths("cuda") for word in ("-L", path)]
    module = package / f"_C{sysconfig.get_config_var('EXT_SUFFIX')}"
    run("c++", "-shared", "-fopenmp", *others, made, *paths, *(f"-l{name}" for name in LIBRARIES), "-o", module)


def measure(name: str, scene_name: str, tets: int | None, plans: Path) -> None:
    """Print one row; run in its own process, since torch loads an extension once."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from gpu_scenes import GPU_SCENES
    from gpu_timing import graph_times
    from scenes import TIME_STEP

    import torchpd as pd
    from torchpd.plan import kernel_choice as regimes

    if tets is not None:
        regimes._STREAM_TETS, regimes._PIPELINE_GROWTH = dict.fromkeys(regimes._STREAM_TETS, tets), 1.0
    scene = next(scene for scene in GPU_SCENES if scene.name == scene_name)
    kept = plans / f"{scene_name}-{tets}.pickle"
    if kept.exists():
        sim: Any = pickle.loads(kept.read_bytes())
    else:
        options: Any = {"dtype": torch.float32, "progress": False, "kernel": scene.kernel}
        sim = pd.Simulator(scene.build(), TIME_STEP, scene.iterations, **options).to("cuda")
        kept.write_bytes(pickle.dumps(sim))
    start = scene.start(sim)
    state = start
    for _ in range(4):
        state = sim(state)
    bits = hashlib.sha256(state.positions.cpu().numpy().tobytes()).hexdigest()[:8]
    steps = []
    for iterations in (64, 128):
        sim.iterations = iterations
        steps.append(1e6 * statistics.median(graph_times(lambda: sim(start), repetitions=7, seconds=0.3)))
    each, marginal = steps[0] / 64, (steps[1] - steps[0]) / 64
    print(f"{name:24} {sim.plan.patches:8} patches {each:9.2f} us {marginal:9.2f} us  {bits}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="name of a CUDA source in csrc without .cu")
    parser.add_argument("scene")
    parser.add_argument("--patch", type=Path, nargs="*", default=[])
    parser.add_argument("--tets", type=int, nargs="*", default=[None])
    parser.add_argument("--measure", nargs=2, metavar=("NAME", "PLANS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        name, plans = options.measure
        measure(name, options.scene, options.tets[0], Path(plans))
        return
    if not torch.cuda.is_available():
        sys.exit("tools/variants.py times kernels and needs a GPU; torch sees none.")
    linked, flags = objects(), runpy.run_path(str(ROOT / "torchpd" / "common" / "toolkit.py"))["NVCC_FLAGS"]
    patches: dict[str, Path | None] = {"as it is": None, **{str(patch): patch for patch in options.patch}}
    failed = False
    with tempfile.TemporaryDirectory() as made:
        folders = {name: Path(made) / str(number) for number, name in enumerate(patches)}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            made_of = [(folders[name], options.source, patch, linked, flags) for name, patch in patches.items()]
            list(pool.map(lambda arguments: make_variant(*arguments), made_of))
        for tets in options.tets:
            for name in [*patches, "as it is"]:
                environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folders[name]), *sys.path[1:]])}
                size = [] if tets is None else ["--tets", str(tets)]
                command = [sys.executable, __file__, options.source, options.scene, *size, "--measure", name, made]
                failed |= subprocess.run(command, env=environment, check=False).returncode != 0
    if failed:
        sys.exit("some variants could not be measured")


if __name__ == "__main__":
    main()
