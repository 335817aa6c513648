"""What tools/cuda_check.py reads out of the compiler's reports, and what makes its table stale."""

from __future__ import annotations

import runpy
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from programs import ROOT

TABLE = ROOT / "benchmarks" / "results" / "cuda-registers.csv"

REPORT = """nvcc -c x.cu
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function '_Z1av' for 'sm_80'
ptxas info    : Function properties for _Z1av
    72 bytes stack frame, 96 bytes spill stores, 172 bytes spill loads
ptxas info    : Used 128 registers, used 1 barriers, 72 bytes cumulative stack size, 992 bytes cmem[0]
ptxas info    : Function properties for _Z6calledv
    8 bytes stack frame, 9 bytes spill stores, 10 bytes spill loads
ptxas info    : Compiling entry function '_Z1bv' for 'sm_90'
ptxas info    : Function properties for _Z1bv
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 34 registers, used 1 barriers, 768 bytes smem, 800 bytes cmem[0]
"""


@pytest.fixture(scope="module")
def tool() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "cuda_check.py"))


def test_kernels_without_the_functions_they_call(tool: dict[str, Any]) -> None:
    first = {"kernel": "_Z1av", "architecture": "80", "registers": "128", "stack": "72", "spill_stores": "96"}
    second = {"kernel": "_Z1bv", "architecture": "90", "registers": "34", "stack": "0", "spill_stores": "0"}
    assert tool["kernels_of"](REPORT) == [
        first | {"spill_loads": "172", "shared": "0"},
        second | {"spill_loads": "0", "shared": "768"},
    ]


def test_names_keep_their_template_arguments(tool: dict[str, Any]) -> None:
    """A value of an enumeration prints with brackets that are not those of the arguments."""
    for signature, name in (
        ("void pd::rotate<double>(pd::RotationCall<double>)", "pd::rotate<double>"),
        (
            "void pd::fused_step<float, true, true, (pd::generic::Blocks)1, true, 512>(pd::generic::FusedCall<float>)",
            "pd::fused_step<float, true, true, (pd::generic::Blocks)1, true, 512>",
        ),
        (
            "void pd::stream_decide<(pd::Decision)0, double>(pd::Call<double>, int)",
            "pd::stream_decide<(pd::Decision)0, double>",
        ),
        ("void pd::items<pd::Boxes<double> >(pd::Boxes<double>, long)", "pd::items<pd::Boxes<double> >"),
        ("void pd::items<2>(void (*)(int, (pd::Blocks)1))", "pd::items<2>"),
        ("pd::plain(int)", "pd::plain"),
        ("(anonymous namespace)::plain()", "(anonymous namespace)::plain"),
        ("_Z1av", "_Z1av"),  # without c++filt
    ):
        assert tool["kernel_name"](signature) == name


def test_a_kernel_has_one_row_for_each_source_and_architecture(tool: dict[str, Any]) -> None:
    _, rows = tool["read_table"](TABLE)
    names = Counter((row["source"], row["architecture"], row["kernel"]) for row in rows)
    assert len(rows) > 100
    assert [name for name, count in names.items() if count > 1] == []
    assert all(row["kernel"].count(one) == row["kernel"].count(other) for row in rows for one, other in ("<>", "()"))


def test_the_table_has_every_source(tool: dict[str, Any]) -> None:
    _, rows = tool["read_table"](TABLE)
    targets = {path.stem: set(tool["targets_of"](path)) for path in (ROOT / "csrc").rglob("*.cu")}
    found: dict[str, set[str]] = {}
    for row in rows:
        found.setdefault(row["source"].split("-")[-1].removesuffix(".cu"), set()).add(row["architecture"])
    assert found == {name: wanted for name, wanted in targets.items() if name != "runtime"}  # which has no kernels


def test_a_fingerprint_follows_what_the_compiler_reads(tool: dict[str, Any], tmp_path: Path) -> None:
    def write(name: str, text: str) -> str:
        (tmp_path / name).write_text(text, encoding="utf-8")
        stamp: str = tool["fingerprint"](tmp_path)
        return stamp

    write("b.def", "X(1)")
    write("a.h", '#include "b.def"\n#include "nowhere.h"\n#include <vector>\n')
    before = write("a.cu", '#include "a.h"\nint f(); char* s = "// no comment";')
    assert [path.name for path in tool["with_headers"]([tmp_path / "a.cu"], tmp_path)] == ["a.cu", "a.h", "b.def"]
    (tmp_path / "moved").mkdir()
    (tmp_path / "b.def").rename(tmp_path / "moved" / "b.def")
    for name, text in (
        ("a.h", '#include "moved/b.def"\n'),
        ("a.cu", '#include "a.h"\n\nint f( );  // a comment\nchar *s = /* two\nlines */\n"// no comment";'),
        ("of_the_cpu.cpp", '#include "a.h"'),
        ("of_the_cpu.h", "int g();"),
    ):
        stamp = write(name, text)
    assert stamp == before
    for name, text in (
        ("moved/b.def", "X(2)"),
        ("a.cu", '#include "a.h"\nint g(); char* s = "// no comment";'),
        ("a.cu", '#include "a.h"\nint g(); char* s = "// another";'),
        ("c.cu", ""),
    ):
        after = write(name, text)
        assert after != before, name
        before = after


def test_a_table_of_other_sources_fails(
    tool: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "table.csv"
    for made_of, code in ((tool["fingerprint"](), 0), ("012abc", 1)):
        table.write_text(f"source,fingerprint\na.cu,{made_of}\n", encoding="utf-8")
        assert tool["compare_table"](table) == code
    assert f"--table {table}" in capsys.readouterr().err


def test_glue_is_compiled_as_in_a_build_with_cuda(tool: dict[str, Any]) -> None:
    """Every C++ source that only such a build compiles, or that has parts for it."""
    csrc = ROOT / "csrc"
    wanted = {
        path for path in csrc.glob("**/*.cpp") if "cuda" in path.parts[-2:-1] or "TORCHPD_CUDA" in path.read_text()
    }
    assert {csrc / name for name in tool["GLUE"]} == wanted
    command = tool["command_for"]("nvcc", csrc / "binding" / "cuda" / "ops.cpp", ["-I", "x"], ("80",))
    assert {"-DTORCHPD_CUDA", "-std=c++20", "-I", "x"} <= set(command)
    assert "-fsyntax-only" in " ".join(command)


@pytest.mark.parametrize("known", [True, False])
def test_a_quick_check_hurries_where_the_compiler_can(tool: dict[str, Any], known: bool, tmp_path: Path) -> None:
    compiler = tmp_path / "nvcc"
    compiler.write_text(f"#!/bin/sh\necho '--optimize <level>{' --Ofast-compile <level>' * known}'\n")
    compiler.chmod(0o755)
    assert tool["fast_flags"](str(compiler)) == ["--Ofast-compile=max"] * known


def test_a_quick_check_takes_one_architecture_a_source(tool: dict[str, Any]) -> None:
    sources = sorted((ROOT / "csrc").glob("**/*.cu"))
    everything = tool["choose_targets"](sources, quick=False)
    assert everything == {source: tool["targets_of"](source) for source in sources}
    quick = tool["choose_targets"](sources, quick=True)
    assert all(len(quick[source]) == 1 and set(quick[source]) < set(everything[source]) for source in sources)
    assert {target for targets in quick.values() for target in targets} >= set(tool["TARGETS"])


def test_a_table_is_made_of_reports(tool: dict[str, Any], tmp_path: Path) -> None:
    """Of those that are there, without compiling; a name that two kernels share is refused."""
    report, table = tmp_path / "x.cu.txt", tmp_path / "table.csv"
    report.write_text(REPORT, encoding="utf-8")
    tool["write_table"](table, [report], "012abc")
    stamp, rows = tool["read_table"](table)
    assert stamp == "012abc"
    assert [row["architecture"] for row in rows] == ["80", "90"]
    assert table.read_text(encoding="utf-8").splitlines()[1:] in (
        ["x.cu,80,a,128,72,96,172,0,012abc", "x.cu,90,b,34,0,0,0,768,"],
        ["x.cu,80,_Z1av,128,72,96,172,0,012abc", "x.cu,90,_Z1bv,34,0,0,0,768,"],  # without c++filt
    )
    report.write_text(REPORT.replace("'_Z1bv' for 'sm_90'", "'_Z1av' for 'sm_80'"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"x\.cu has two kernels of the name .*a.* for sm_80"):
        tool["write_table"](table, [report], "")
