"""The loops that tools/instructions.py finds in a listing, which is made up here."""

from __future__ import annotations

import runpy
import subprocess
import sys
from typing import Any

import pytest
from programs import ROOT

TOOLS = ROOT / "tools"
# a loop from 2 to 9 that holds one from 5 to 6, which a branch jumps over, and has rare parts behind the end
CODE = (
    "MOV R1, c[0x0][0x28]",
    "@P0 EXIT",
    "IADD3 R2, R2, 0x1, RZ",
    "@!P1 BRA 0x0070",
    "BRA.DIV UR4, 0x00d0",
    "FADD R3, R3, R4",
    "@!P2 BRA P3, 0x0050",
    "@P4 BRA 0x00b0",
    "CALL.REL.NOINC 0x00e0",
    "@P5 BRA.U 0x0020",
    "EXIT",
    "FMUL R5, R5, R5",
    "BRA 0x0080",
    "BRA 0x0050",
    "RET.REL.NODEC R8 0x0",
    "BRA 0x00f0",
)


def listing(name: str, code: tuple[str, ...]) -> str:
    """As cuobjdump prints it: the words of every instruction follow it as numbers."""
    number = 32 * " " + "/* 0x000fe20000000a00 */"
    lines = [
        f"        /*{16 * i:04x}*/   {words} ;   /* 0x0000000000027ab9 */\n{number}" for i, words in enumerate(code)
    ]
    return "\n".join([f"\t\tFunction : {name}", '\t.headerflags\t@"EF_CUDA_SM90"', *lines, "\t\t..........\n"])


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(str(TOOLS))
    return runpy.run_path(str(TOOLS / "instructions.py"))


def test_loops_of_a_listing(tool: dict[str, Any]) -> None:
    """All of 2 to 9, of which a pass jumps over 4 to 6; and what pads the function."""
    functions = dict(tool["functions_of"]("Fatbin elf code:\n" + listing("_Z1av", CODE) + listing("_Z1bv", CODE[:2])))
    assert list(functions) == ["_Z1av", "_Z1bv"]
    assert [*functions["_Z1av"].values()] == list(CODE)
    assert tool["loops_of"](functions["_Z1av"]) == [(0x20, 8, 5), (0x50, 2, 2), (0xF0, 1, 1)]
    assert tool["loops_of"](functions["_Z1bv"]) == []


def test_a_conditional_way_out_does_not_end_a_loop(tool: dict[str, Any]) -> None:
    code = ("NOP", "@P0 EXIT", "@P1 BRA 0x0000", "EXIT")
    (code_of,) = (code for _, code in tool["functions_of"](listing("_Z1av", code)))
    assert tool["loops_of"](code_of) == [(0, 3, 3)]


def test_what_is_missing_is_said() -> None:
    for source, words in (
        ("nothing", "there is no nothing.cu in csrc/"),
        ("fused_float", "nvcc not found: set CUDA_HOME"),
    ):
        command = [sys.executable, TOOLS / "instructions.py", source]
        result = subprocess.run(command, env={"CUDA_HOME": "/nowhere"}, capture_output=True, text=True, check=False)
        assert result.returncode == 2
        assert words in result.stderr
