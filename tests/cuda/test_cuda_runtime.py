"""What runtime.cu says where a GPU cannot do what is asked: compiled for the host, with a CUDA made here."""

from __future__ import annotations

import runpy
import subprocess

import pytest
from programs import ROOT

# An A100 without code, whose blocks may have 166912 bytes; it counts how often an error was cleared.
PROGRAM = """
#include "cuda/common/runtime.h"
#include <exception>
#include <iostream>

extern "C" {
static int cleared = 0;
cudaError_t cudaGetLastError() { ++cleared; return cudaSuccess; }
const char* cudaGetErrorString(cudaError_t) { return "some words"; }
cudaError_t cudaGetDevice(int* device) { *device = 0; return cudaSuccess; }
cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr which, int) {
  *value = which == cudaDevAttrComputeCapabilityMajor ? 8
           : which == cudaDevAttrMaxSharedMemoryPerBlockOptin ? 166912 : 0;
  return cudaSuccess;
}
cudaError_t cudaFuncGetAttributes(cudaFuncAttributes*, const void*) { return cudaErrorNoKernelImageForDevice; }
cudaError_t cudaFuncSetAttribute(const void*, cudaFuncAttribute, int) { return cudaSuccess; }
cudaError_t cudaOccupancyMaxActiveBlocksPerMultiprocessor(int*, const void*, int, size_t) { return cudaSuccess; }
cudaError_t cudaOccupancyMaxActiveClusters(int*, const void*, const cudaLaunchConfig_t*) { return cudaSuccess; }
cudaError_t cudaLaunchKernelExC(const cudaLaunchConfig_t*, const void*, void**) { return cudaSuccess; }
}

template <class Call>
void say(const Call& call) {
  cleared = 0;
  try {
    call();
    std::cout << "nothing";
  } catch (const std::exception& error) {
    std::cout << error.what();
  }
  std::cout << " [" << cleared << "]\\n";
}

int main() {
  say([] { pd::resident_blocks(nullptr, 32, 0); });
  for (cudaError_t status : {cudaSuccess, cudaErrorUnsupportedPtxVersion, cudaErrorMemoryAllocation})
    say([&] { pd::check(status); });
  say([] { pd::refuse_shared_memory(200000); });
  for (std::int64_t count : {2147483647ll, 2147483648ll}) say([&] { pd::blocks_of(count); });
}
"""


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the program prints, line by line."""
    nvcc = runpy.run_path(str(ROOT / "tools" / "cuda_check.py"))["find_tool"]("nvcc")
    if nvcc is None:
        pytest.skip("there is no CUDA toolkit, whose headers this needs")
    folder = tmp_path_factory.mktemp("runtime")
    (folder / "main.cpp").write_text(PROGRAM, encoding="utf-8")
    program = folder / "program"
    sources = [folder / "main.cpp", ROOT / "csrc" / "cuda" / "common" / "runtime.cu"]
    flags = ["-std=c++20", "-x", "c++", "--cudart", "none", "-I", ROOT / "csrc"]
    subprocess.run([nvcc, *flags, *sources, "-o", program], check=True)
    return subprocess.run([program], capture_output=True, text=True, check=True).stdout.splitlines()


def test_a_build_without_code_for_the_gpu_says_how_to_get_it(words: list[str]) -> None:
    """And no error stays behind for the next call."""
    remedy = (
        "torchpd: CUDA says: some words; this build has no code for the GPU, of compute capability 8.0: "
        "build torchpd again with TORCH_CUDA_ARCH_LIST=8.0 in the environment [1]"
    )
    assert words[0] == words[2] == remedy
    assert words[1] == "nothing [0]"
    assert words[3] == "torchpd: CUDA says: some words [1]"


def test_a_patch_that_wants_too_much_shared_memory_says_whose_plan_it_is(words: list[str]) -> None:
    assert words[4] == (
        "torchpd: a patch of the plan wants 200000 bytes of shared memory, and a block of this device has up to "
        '166912: the plan is for another GPU; sim.to("cpu").to("cuda") compiles the scene for this one [0]'
    )


def test_a_launch_of_too_many_blocks_says_how_many_there_are(words: list[str]) -> None:
    assert words[5] == "nothing [0]"
    assert words[6] == (
        "torchpd: the batch needs 2147483648 thread blocks, and one launch has up to 2147483647: "
        "split it into several calls [0]"
    )
