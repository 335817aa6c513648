"""A case: what is compared, with what, and what torchpd gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Case"]


@dataclass(frozen=True)
class Case:
    """A number of torchpd beside a closed form or a published number.

    `error` is found / expected - 1, or found itself where the expected value is zero.
    """

    table: str  # title of the table that has the case
    row: str  # label of its row
    column: str  # label of its column, or the quantity that is compared
    source: str  # closed form or publication
    expected: float
    run: Callable[[], float]  # the number of torchpd
    bound: float | None = None  # largest |error| that tests accept; None: reported alone
    quick: bool = False  # also a case of `--quick`
    published: str = ""  # a published range, in the middle of which `expected` lies

    @property
    def key(self) -> str:
        return f"{self.table} / {self.row} / {self.column}"

    def error(self, found: float) -> float:
        return found / self.expected - 1.0 if self.expected else found
