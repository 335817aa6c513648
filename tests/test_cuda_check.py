"""What tools/cuda_check.py reads out of the compiler's reports."""

from __future__ import annotations

import csv
import runpy
from collections import Counter
from pathlib import Path

import pytest

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


def test_kernels_without_the_functions_they_call() -> None:
    tool = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "cuda_check.py"))
    first = {"kernel": "_Z1av", "architecture": "80", "registers": "128", "stack": "72", "spill_stores": "96"}
    second = {"kernel": "_Z1bv", "architecture": "90", "registers": "34", "stack": "0", "spill_stores": "0"}
    assert tool["kernels_of"](REPORT) == [
        first | {"spill_loads": "172", "shared": "0"},
        second | {"spill_loads": "0", "shared": "768"},
    ]


TABLE = Path(__file__).parent.parent / "benchmarks" / "results" / "cuda-registers.csv"


def test_names_keep_their_template_arguments() -> None:
    """A value of an enumeration prints with brackets that are not those of the arguments."""
    tool = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "cuda_check.py"))
    for signature, name in (
        ("void pd::rotate<double>(pd::RotationCall<double>)", "pd::rotate<double>"),
        (
            "void pd::fused_step<float, true, (pd::generic::Blocks)1, true, 512>(pd::generic::FusedCall<float>)",
            "pd::fused_step<float, true, (pd::generic::Blocks)1, true, 512>",
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


def test_a_kernel_has_one_row_for_each_source_and_architecture() -> None:
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = Counter((row["source"], row["architecture"], row["kernel"]) for row in rows)
    assert len(rows) > 100
    assert [name for name, count in names.items() if count > 1] == []
    assert all(row["kernel"].count(one) == row["kernel"].count(other) for row in rows for one, other in ("<>", "()"))


def test_a_table_is_made_of_reports(tmp_path: Path) -> None:
    """Of those that are there, without compiling; a name that two kernels share is refused."""
    tool = runpy.run_path(str(Path(__file__).parent.parent / "tools" / "cuda_check.py"))
    report, table = tmp_path / "x.cu.txt", tmp_path / "table.csv"
    report.write_text(REPORT, encoding="utf-8")
    tool["write_table"](table, [report])
    assert table.read_text(encoding="utf-8").splitlines()[1:] in (
        ["x.cu,80,a,128,72,96,172,0", "x.cu,90,b,34,0,0,0,768"],
        ["x.cu,80,_Z1av,128,72,96,172,0", "x.cu,90,_Z1bv,34,0,0,0,768"],  # without c++filt
    )
    report.write_text(REPORT.replace("'_Z1bv' for 'sm_90'", "'_Z1av' for 'sm_80'"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"x\.cu has two kernels of the name .*a.* for sm_80"):
        tool["write_table"](table, [report])
