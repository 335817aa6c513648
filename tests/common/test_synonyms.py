"""Names of other libraries are answered with ours; `dir` shows what is public."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

import pytest

import torchpd as pd
from torchpd.common.synonyms import SYNONYMS

MESH = pd.shapes.box((1.0, 0.2, 0.2), (2, 1, 1))
SIM = pd.Simulator(pd.Scene(pd.Solid(MESH, youngs=1e5)), iterations=1)
ENTRIES = [(owner, names, answer) for owner, rows in SYNONYMS.items() for names, answer in rows.items()]


def called(owner: str) -> Callable[..., Any]:
    """What an owner's arguments are given to."""
    value = SIM if owner.startswith("Simulator.") else pd
    return getattr(value, owner.removeprefix("Simulator."))


@pytest.mark.parametrize(("owner", "names", "answer"), ENTRIES, ids=lambda text: text[:24])
def test_every_name_is_answered(owner: str, names: str, answer: str) -> None:
    for name in names.split():
        if owner == "":
            with pytest.raises(AttributeError, match=re.escape(f"torchpd has no attribute {name!r}; {answer}")):
                getattr(pd, name)
            continue
        with pytest.raises(TypeError, match=re.escape(f"{owner} has no argument {name!r}; {answer}")):
            called(owner)(**{name: 1.0})
        if owner == "Simulator" and not hasattr(SIM, name):
            with pytest.raises(AttributeError, match=re.escape(f"Simulator has no attribute {name!r}; {answer}")):
                getattr(SIM, name)


@pytest.mark.parametrize(("owner", "names", "answer"), ENTRIES, ids=lambda text: text[:24])
def test_answers_name_what_is_there(owner: str, names: str, answer: str) -> None:
    """Names in backquotes are arguments of the owner, or names of the module that are followed by a call or nothing."""
    given = inspect.signature(called(owner)).parameters.values() if owner else ()
    ours = {*pd.__all__, *(one.name for one in given if one.kind != one.VAR_POSITIONAL)}
    quoted = [re.match(r"\w+", text) for text in re.findall(r"`([^`]+)`", answer)]
    assert {found.group() for found in quoted if found} <= ours
    for name, arguments in re.findall(r"(\w+)\(([^()]*)", answer):
        if name in pd.__all__:
            there = inspect.signature(getattr(pd, name)).parameters
            assert set(re.findall(r"(\w+)=", arguments)) <= set(there)
    assert not ours.intersection(names.split())


def test_other_unknown_arguments_get_the_list() -> None:
    with pytest.raises(TypeError, match=r"^Solid has no argument 'yongs'; .*stiffness_damping, plastic$"):
        pd.Solid(MESH, yongs=1e5)
    with pytest.raises(TypeError, match=r"^Scene has no argument 'wind'; "):
        pd.Scene(pd.Solid(MESH, youngs=1e5), wind=1.0)
    with pytest.raises(AttributeError, match=r"^torchpd has no attribute 'Rain'$") as caught:
        pd.Rain  # noqa: B018
    assert (caught.value.name, hasattr(pd, "Rain")) == ("Rain", False)


def test_errors_of_python_name_the_class_of_users() -> None:
    with pytest.raises(TypeError, match=r"^Simulator\.forward\(\) .*'dt'"):
        SIM(SIM.rest_state(), dt=0.1)
    with pytest.raises(TypeError, match=r"^Simulator\.contact_forces\(\) "):
        SIM.contact_forces()


def test_dir_shows_what_is_public() -> None:
    shown = {name for name in dir(pd) if not name.startswith("__")}
    assert shown == {name for name in pd.__all__ if not name.startswith("__")}
    assert inspect.ismodule(importlib.import_module("torchpd.viewing.render"))  # others can be imported all the same
